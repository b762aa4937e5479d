//! No module uses what it must not: the table below is the one of `docs/architecture.md`, and every
//! path in `src` that begins with `crate` or `super` is held against it. Test modules are free to
//! use what they like.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Modules that all others may use; they use nothing but each other.
const BASE: &[&str] = &[
    "command", "fence", "frames", "odometry", "scan", "tail", "time", "tunable", "units", "vehicle",
];

/// What each module may use besides itself and [`BASE`]. The longest name that fits a module
/// counts. An entry with `::` allows just that item.
const MAY_USE: &[(&str, &[&str])] = &[
    ("mapfile", &[]),
    ("wire", &[]),
    ("map", &["mapfile"]),
    ("localize", &["map"]),
    ("predict", &["map"]),
    // The planner knows that there is a predictor, never which.
    (
        "plan",
        &[
            "map",
            "predict::OccupancyView",
            "predict::PredictReport",
            "predict::Predictor",
            "predict::Scene",
            "predict::Supervised",
        ],
    ),
    // The proof of a plan never sees a prediction.
    ("plan::certify", &["map"]),
    ("control", &["plan::Path", "plan::PathPoint", "plan::Trajectory", "plan::TrajectoryPoint"]),
    // The last word on every setpoint shares no code with those whose work it checks.
    ("guard", &[]),
    ("ground", &["wire", "params"]),
    (
        "autopilot",
        &[
            "mapfile", "wire", "map", "localize", "predict", "plan", "control", "guard", "ground",
            "params",
        ],
    ),
    // Geometry of its own: a mistake in `map` or `plan` cannot cancel itself here.
    ("sim", &["mapfile", "wire"]),
    (
        "sim::rig",
        &[
            "mapfile",
            "wire",
            "map",
            "localize",
            "predict",
            "plan",
            "control",
            "guard",
            "ground",
            "autopilot",
            "params",
        ],
    ),
    (
        "params",
        &[
            "mapfile",
            "wire",
            "map",
            "localize",
            "predict",
            "plan",
            "control",
            "guard",
            "ground",
            "autopilot",
            "sim",
            "shell::daemon::DaemonParams",
        ],
    ),
    (
        "experiment",
        &[
            "mapfile",
            "wire",
            "map",
            "localize",
            "predict",
            "plan",
            "control",
            "guard",
            "ground",
            "autopilot",
            "sim",
            "params",
        ],
    ),
    // To replay is to feed the core.
    ("record", &["wire", "map", "predict", "plan", "autopilot", "params"]),
    (
        "shell",
        &[
            "mapfile",
            "wire",
            "map",
            "localize",
            "predict",
            "plan",
            "control",
            "guard",
            "ground",
            "autopilot",
            "sim",
            "experiment",
            "record",
            "params",
        ],
    ),
];

/// Macros that live at the root of the crate, with the module that defines them.
const MACROS: &[(&str, &str)] = &[("tunables", "tunable"), ("choices", "tunable")];

#[test]
fn no_module_uses_what_it_must_not() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    collect(&root, &mut files);
    let texts: Vec<(PathBuf, String)> = files
        .into_iter()
        .map(|path| {
            let text = std::fs::read_to_string(&path).unwrap();
            (path.strip_prefix(&root).unwrap().to_owned(), text)
        })
        .collect();
    assert!(texts.len() > 10, "only {} files in {}", texts.len(), root.display());
    let faults = faults(&texts);
    assert!(faults.is_empty(), "forbidden uses:\n{}", faults.join("\n"));
}

#[test]
fn forbidden_uses_are_found_in_every_form() {
    for (file, text, fault) in [
        ("guard/mod.rs", "use crate::map::Grid;", "guard uses map::Grid"),
        ("guard/mod.rs", "pub(crate) use crate::{frames::Pose, map as m};", "guard uses map"),
        ("guard/a.rs", "fn f() -> crate::plan::Path { todo!() }", "guard::a uses plan::Path"),
        ("guard/a.rs", "use super::super::map::{Cell};", "guard::a uses map::Cell"),
        ("guard/mod.rs", "mod x { use super::super::map; }", "guard::x uses map"),
        ("guard.rs", "use crate::{scan::Scan, plan::{speed::A}};", "guard uses plan::speed::A"),
        ("map/mod.rs", "use crate::plan::Path;", "map uses plan::Path"),
        ("plan/certify.rs", "use crate::predict::OccupancyView;", "plan::certify uses predict"),
        ("plan/certify/x.rs", "use crate::predict::OccupancyView;", "plan::certify::x uses predi"),
        ("plan/search.rs", "use crate::predict::Oracle;", "plan::search uses predict::Oracle"),
        ("sim/lidar.rs", "use crate::map::Grid;", "sim::lidar uses map::Grid"),
        ("time.rs", "use crate::map::Grid;", "time uses map::Grid"),
        ("control/mod.rs", "use crate::plan::Planner;", "control uses plan::Planner"),
        ("planner.rs", "", "planner has no row"),
        ("guard/mod.rs", "#[cfg(test)] mod t { } use crate::map;", "guard uses map"),
        ("guard/mod.rs", "const X: &str = \"//\"; use crate::map;", "guard uses map"),
        ("guard/mod.rs", "const X: char = '\"'; use crate::map; // \"", "guard uses map"),
    ] {
        let found = faults(&[(PathBuf::from(file), text.to_owned())]);
        assert!(found.len() == 1 && found[0].contains(fault), "{file}: {text}: {found:?}");
    }
}

#[test]
fn allowed_uses_are_not_faults() {
    for (file, text) in [
        ("guard/mod.rs", "use crate::{frames::Pose, tunables}; use self::x::y; mod x;"),
        (
            "guard/mod.rs",
            "// use crate::map;\n/* crate::map /* */ */ const A: &str = \"crate::map\";",
        ),
        ("guard/mod.rs", "const A: &str = r#\"crate::map\"#; fn f<'a>(x: &'a str) {}"),
        ("guard/mod.rs", "#[cfg(test)]\nmod tests { fn f() { { } use crate::map::Grid; } }"),
        ("guard/a.rs", "use super::Limits; use super::super::frames::Pose;"),
        ("plan/search/astar.rs", "use crate::predict::OccupancyView; use crate::map::Cell;"),
        ("plan/certify.rs", "use crate::plan::Path; use crate::map::Grid;"),
        ("control/mod.rs", "use crate::plan::{Path, Trajectory};"),
        ("sim/rig/mod.rs", "use crate::autopilot::Core; use crate::sim::drive::Summary;"),
        ("lib.rs", "pub mod map;"),
        ("main.rs", "use apexd::shell;"),
    ] {
        let found = faults(&[(PathBuf::from(file), text.to_owned())]);
        assert!(found.is_empty(), "{file}: {text}: {found:?}");
    }
}

#[test]
fn a_file_that_only_tests_compile_is_free() {
    let files = [
        (
            "guard/mod.rs",
            "#[cfg(test)]\n#[path = \"other.rs\"]\nmod trial;\n#[cfg(test)] mod probe;",
        ),
        ("guard/other.rs", "use crate::map::Grid;"),
        ("guard/probe.rs", "use crate::map::Grid;"),
        ("guard/probe/deep.rs", "use crate::map::Grid;"),
        ("guard/real.rs", "use crate::map::Grid;"),
    ];
    let files = files.map(|(path, text)| (PathBuf::from(path), text.to_owned()));
    assert_eq!(faults(&files), ["guard::real uses map::Grid (guard/real.rs)"]);
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    let entries = std::fs::read_dir(folder).expect("the sources are readable");
    for entry in entries {
        let path = entry.expect("the sources are readable").path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|extension| extension == "rs") {
            files.push(path);
        }
    }
    files.sort();
}

/// Everything forbidden in the files, which are given by their paths below `src`.
fn faults(files: &[(PathBuf, String)]) -> Vec<String> {
    let parsed: Vec<(Vec<String>, File)> = files
        .iter()
        .filter(|(path, _)| path != Path::new("main.rs"))
        .map(|(path, text)| {
            let module = module_of(path);
            let own_folder = path.parent().unwrap_or(Path::new(""));
            (module.clone(), read(&module, own_folder, &tokens(text)))
        })
        .collect();
    let test_modules: BTreeSet<&[String]> =
        parsed.iter().flat_map(|(_, file)| &file.test_modules).map(Vec::as_slice).collect();
    let test_files: BTreeSet<&PathBuf> =
        parsed.iter().flat_map(|(_, file)| &file.test_files).collect();
    let mut found = Vec::new();
    let sources = files.iter().filter(|(path, _)| path != Path::new("main.rs"));
    for ((path, _), (module, file)) in sources.zip(&parsed) {
        let for_tests = (0..=module.len()).any(|n| test_modules.contains(&module[..n]));
        if module.is_empty() || for_tests || test_files.contains(path) {
            continue;
        }
        let at = path.display();
        if row(module).is_none() {
            found.push(format!("{} has no row in the table ({at})", module[0]));
        }
        for (user, used) in &file.uses {
            if !allowed(user, used) {
                found.push(format!("{} uses {} ({at})", user.join("::"), used.join("::")));
            }
        }
    }
    found
}

/// The module that a file below `src` holds; nothing for the root.
fn module_of(path: &Path) -> Vec<String> {
    let mut parts: Vec<String> =
        path.with_extension("").iter().map(|part| part.to_string_lossy().into_owned()).collect();
    if matches!(parts.last().map(String::as_str), Some("mod" | "lib")) {
        parts.pop();
    }
    parts
}

/// What a module may use besides itself and the base; `None` if the table does not know it.
fn row(module: &[String]) -> Option<&'static [&'static str]> {
    if BASE.contains(&module[0].as_str()) {
        return Some(&[]);
    }
    let fits = |name: &str| {
        let parts: Vec<&str> = name.split("::").collect();
        module.len() >= parts.len() && module.iter().zip(&parts).all(|(a, b)| a == b)
    };
    MAY_USE.iter().filter(|(name, _)| fits(name)).max_by_key(|(name, _)| name.len()).map(|r| r.1)
}

fn allowed(user: &[String], used: &[String]) -> bool {
    let Some(first) = used.first() else { return true };
    let first = MACROS.iter().find(|(name, _)| name == first).map_or(first.as_str(), |m| m.1);
    let Some(row) = row(user) else { return true };
    first == user[0]
        || BASE.contains(&first)
        || row.iter().any(|entry| {
            let parts: Vec<&str> = entry.split("::").collect();
            parts[0] == first && (parts.len() == 1 || used.get(1).is_some_and(|u| u == parts[1]))
        })
}

/// What matters of one file.
#[derive(Default)]
struct File {
    /// Which module uses which path from the root of the crate.
    uses: Vec<(Vec<String>, Vec<String>)>,
    /// Modules in files of their own that only tests compile.
    test_modules: Vec<Vec<String>>,
    /// Files of such modules, where their path is given.
    test_files: Vec<PathBuf>,
}

fn read(module: &[String], own_folder: &Path, tokens: &[String]) -> File {
    let mut file = File::default();
    let token = |i: usize| tokens.get(i).map_or("", String::as_str);
    // Modules written in line that are open, with the depth of braces around them.
    let mut inner: Vec<(String, usize)> = Vec::new();
    let (mut depth, mut i) = (0usize, 0);
    while i < tokens.len() {
        let here = || -> Vec<String> {
            module.iter().cloned().chain(inner.iter().map(|(name, _)| name.clone())).collect()
        };
        match token(i) {
            "#" if tokens[i..]
                .iter()
                .take(7)
                .map(String::as_str)
                .eq(["#", "[", "cfg", "(", "test", ")", "]"]) =>
            {
                i = skip_test_item(&mut file, &here(), own_folder, tokens, i + 7);
                continue;
            }
            "mod" if token(i + 2) == "{" => {
                inner.push((token(i + 1).to_owned(), depth));
                depth += 1;
                i += 3;
                continue;
            }
            "{" => depth += 1,
            "}" => {
                depth = depth.saturating_sub(1);
                if inner.last().is_some_and(|(_, at)| *at == depth) {
                    inner.pop();
                }
            }
            "crate" if token(i + 1) == "::" => {
                i = tree(tokens, i + 2, &mut Vec::new(), &here(), &mut file.uses);
                continue;
            }
            "super" if token(i + 1) == "::" => {
                let mut base = here();
                while token(i) == "super" && token(i + 1) == "::" {
                    base.pop();
                    i += 2;
                }
                i = tree(tokens, i, &mut base, &here(), &mut file.uses);
                continue;
            }
            _ => {}
        }
        i += 1;
    }
    file
}

/// Steps over the item behind `#[cfg(test)]` and remembers a module in a file of its own.
fn skip_test_item(
    file: &mut File,
    here: &[String],
    own_folder: &Path,
    tokens: &[String],
    mut i: usize,
) -> usize {
    let token = |i: usize| tokens.get(i).map_or("", String::as_str);
    let mut path = None;
    while token(i) == "#" {
        if token(i + 2) == "path" {
            path = Some(token(i + 4).trim_matches('"').to_owned());
        }
        i += 1 + tokens[i..].iter().position(|t| t == "]").unwrap_or(0);
    }
    let end = tokens[i..].iter().position(|t| t == ";" || t == "{").map_or(tokens.len(), |n| i + n);
    if token(end) != "{" {
        if let Some(at) = tokens[i..end].iter().position(|t| t == "mod") {
            match path {
                Some(path) => file.test_files.push(own_folder.join(path)),
                None => {
                    let name = token(i + at + 1).to_owned();
                    file.test_modules.push(here.iter().cloned().chain([name]).collect());
                }
            }
        }
        return end + 1;
    }
    let (mut depth, mut i) = (0usize, end);
    while i < tokens.len() {
        match token(i) {
            "{" => depth += 1,
            "}" => depth -= 1,
            _ => {}
        }
        i += 1;
        if depth == 0 {
            // `use crate::{a, b};` ends behind its brace.
            return if token(i) == ";" { i + 1 } else { i };
        }
    }
    i
}

/// Reads a path or a tree of paths and returns where it ends.
fn tree(
    tokens: &[String],
    mut i: usize,
    base: &mut Vec<String>,
    user: &[String],
    uses: &mut Vec<(Vec<String>, Vec<String>)>,
) -> usize {
    let token = |i: usize| tokens.get(i).map_or("", String::as_str);
    let length = base.len();
    loop {
        if token(i) == "{" {
            i += 1;
            while i < tokens.len() && token(i) != "}" {
                let before = i;
                i = tree(tokens, i, base, user, uses);
                while !matches!(token(i), "," | "}" | "") {
                    i += 1; // `as name`
                }
                if token(i) == "," || i == before {
                    i += 1;
                }
            }
            i += 1;
            break;
        }
        if token(i) != "self" {
            base.push(token(i).to_owned());
        }
        i += 1;
        if token(i) == "::" {
            i += 1;
        } else {
            uses.push((user.to_vec(), base.clone()));
            break;
        }
    }
    base.truncate(length);
    i
}

/// The text's words and signs, without comments; texts as one token each.
fn tokens(text: &str) -> Vec<String> {
    let chars: Vec<char> = text.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let (mut tokens, mut i) = (Vec::new(), 0);
    while i < chars.len() {
        let start = i;
        match at(i) {
            '/' if at(i + 1) == '/' => {
                while i < chars.len() && at(i) != '\n' {
                    i += 1;
                }
                continue;
            }
            '/' if at(i + 1) == '*' => {
                let mut depth = 0;
                loop {
                    match (at(i), at(i + 1)) {
                        ('/', '*') => (depth, i) = (depth + 1, i + 2),
                        ('*', '/') => (depth, i) = (depth - 1, i + 2),
                        _ => i += 1,
                    }
                    if depth == 0 || i >= chars.len() {
                        break;
                    }
                }
                continue;
            }
            'r' if at(i + 1) == '"' || (at(i + 1) == '#' && matches!(at(i + 2), '"' | '#')) => {
                let hashes = (i + 1..).take_while(|&j| at(j) == '#').count();
                i += 2 + hashes;
                let closes = |j: usize| at(j) == '"' && (1..=hashes).all(|n| at(j + n) == '#');
                while i < chars.len() && !closes(i) {
                    i += 1;
                }
                i += 1 + hashes;
            }
            '"' => {
                i += 1;
                while i < chars.len() && at(i) != '"' {
                    i += if at(i) == '\\' { 2 } else { 1 };
                }
                i += 1;
            }
            // A character, not a lifetime.
            '\'' if at(i + 1) == '\\' || at(i + 2) == '\'' => {
                i += if at(i + 1) == '\\' { 3 } else { 2 };
                while i < chars.len() && at(i) != '\'' {
                    i += 1;
                }
                i += 1;
            }
            c if is_word(c) => {
                while is_word(at(i)) {
                    i += 1;
                }
            }
            ':' if at(i + 1) == ':' => i += 2,
            c if c.is_whitespace() => {
                i += 1;
                continue;
            }
            _ => i += 1,
        }
        tokens.push(chars[start..i.min(chars.len())].iter().collect());
    }
    tokens
}
