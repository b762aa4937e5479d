"""What MAVLink's component_metadata/*.schema.json (draft 7, no further properties) ask of the files that
describe parameters, written down by hand. The parameter schema's `version` is left out on purpose: it
asks for 3 or more (state of July 2026), and QGroundControl reads nothing but 1 (CompInfoParam.cc)."""

import re

GENERAL_ENTRY = {"type": int, "uri": str, "fileCrc": int}
PARAMETER = {
    "name": str, "type": str, "shortDesc": str, "longDesc": str, "units": str,
    "default": (int, float), "decimalPlaces": int, "min": (int, float), "max": (int, float),
    "increment": (int, float), "rebootRequired": bool, "group": str, "category": str,
    "volatile": bool, "values": list, "bitmask": list, "readOnly": bool,
}
TYPES = {"Uint8", "Int8", "Uint16", "Int16", "Uint32", "Int32", "Float"}
NAME = re.compile(r"^[.\-a-zA-Z0-9_{}]{1,16}$")
PARAMETER_METADATA = 1


def crc32(data):
    """MAVLink's: reflected, nothing inverted."""
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc >> 1) ^ (0xEDB88320 if crc & 1 else 0)
    return crc


def check_general(test, general):
    """The entry about parameters, which is all that this car describes."""
    test.assertEqual(set(general), {"version", "metadataTypes"})
    test.assertGreaterEqual(general["version"], 1)
    [entry] = general["metadataTypes"]
    for key, value in entry.items():
        test.assertIsInstance(value, GENERAL_ENTRY[key])
    test.assertEqual(entry["type"], PARAMETER_METADATA)
    return entry


def check_parameters(test, parameters):
    """The names of the parameters."""
    test.assertEqual(set(parameters), {"version", "parameters"})
    test.assertEqual(parameters["version"], 1)
    for row in parameters["parameters"]:
        for key, value in row.items():
            test.assertIsInstance(value, PARAMETER[key], (row, key))
        test.assertRegex(row["name"], NAME)
        test.assertIn(row["type"], TYPES)
        test.assertGreaterEqual(row.get("decimalPlaces", 0), 0)
        for value in row.get("values", []):
            test.assertEqual(set(value), {"value", "description"})
            test.assertIsInstance(value["value"], (int, float))
            test.assertIsInstance(value["description"], str)
    return {row["name"] for row in parameters["parameters"]}
