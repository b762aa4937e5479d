//! Every tunable parameter of the program, from built-in defaults to validated values.
//!
//! Each module declares its own parameters; [`Params`] gathers the sections, [`Layers`] puts a
//! file, the environment and the command line over the defaults, and [`document`] writes the table
//! down for people.

pub mod document;
mod fault;
mod ids;
mod layers;

pub use fault::{Fault, Faults, Origin, Problem};
pub use ids::{ID_LENGTH, id_of, ids};
pub use layers::{ENVIRONMENT_PREFIX, Layers, kept_text, toml_text};

use crate::autopilot::CoreParams;
use crate::plan::PlannerParams;
use crate::tunable::{Section, Tunable, TunableError, Value};

/// One section of the parameter table.
#[derive(Clone, Debug, PartialEq)]
pub struct SectionTable {
    /// Name in the configuration file.
    pub name: &'static str,
    /// What the section is about.
    pub text: &'static str,
    /// Its parameters, in order of declaration.
    pub rows: Vec<Tunable>,
}

/// Declares [`Params`] from the sections: `name: Type`, one a line.
macro_rules! sections {
    ($($field:ident: $type:ty),+ $(,)?) => {
        /// The values of every section.
        #[derive(Clone, Debug, Default, PartialEq)]
        pub struct Params {
            $(
                #[doc = concat!("Section `[", stringify!($field), "]`.")]
                pub $field: $type,
            )+
        }

        impl Params {
            /// The table of every section, in order of declaration.
            pub fn table() -> Vec<SectionTable> {
                vec![$(SectionTable {
                    name: <$type as Section>::NAME,
                    text: <$type as Section>::TEXT,
                    rows: <$type as Section>::table(),
                }),+]
            }

            /// The present value of `section.name`.
            pub fn get(&self, key: &str) -> Option<Value> {
                let (section, name) = key.split_once('.')?;
                $(if section == <$type as Section>::NAME {
                    return self.$field.get(name);
                })+
                None
            }

            /// Checks and stores the value of `section.name`.
            pub fn set(&mut self, key: &str, value: &Value) -> Result<(), TunableError> {
                let (section, name) = key.split_once('.').ok_or(TunableError::Unknown)?;
                $(if section == <$type as Section>::NAME {
                    return self.$field.set(name, value);
                })+
                Err(TunableError::Unknown)
            }
        }

        /// Field names of [`Params`], to be compared with the sections' own names.
        #[cfg(test)]
        const FIELDS: &[&str] = &[$(stringify!($field)),+];
    };
}

sections! {
    vehicle: crate::vehicle::VehicleParams,
    can: crate::wire::can::CanParams,
    autopilot: crate::autopilot::AutopilotParams,
    map: crate::map::MapParams,
    predict: crate::predict::PredictParams,
    plan: crate::plan::PlanParams,
    search: crate::plan::search::SearchParams,
    janson: crate::plan::JansonParams,
    manoeuvre: crate::plan::search::ManoeuvreParams,
    smooth: crate::plan::smooth::SmoothParams,
    speed: crate::plan::speed::SpeedParams,
    foreseen: crate::plan::ForeseenParams,
    certify: crate::plan::certify::CertifyParams,
    control: crate::control::ControlParams,
    guard: crate::guard::GuardParams,
    daemon: crate::shell::daemon::DaemonParams,
    car: crate::sim::car::CarParams,
    controller: crate::sim::controller::ControllerParams,
    lidar: crate::sim::lidar::LidarParams,
    bus: crate::sim::bus::BusParams,
    mavlink: crate::ground::MavlinkParams,
}

impl Params {
    /// The sections that the core is made of.
    pub fn core(&self) -> CoreParams {
        CoreParams {
            vehicle: self.vehicle.clone(),
            autopilot: self.autopilot.clone(),
            map: self.map.clone(),
            control: self.control.clone(),
            guard: self.guard.clone(),
            certify: self.certify.clone(),
            speed: self.speed.clone(),
        }
    }

    /// The sections that the planner is made of.
    pub fn planner(&self) -> PlannerParams {
        PlannerParams {
            vehicle: self.vehicle.clone(),
            plan: self.plan.clone(),
            search: self.search.clone(),
            manoeuvre: self.manoeuvre.clone(),
            smooth: self.smooth.clone(),
            speed: self.speed.clone(),
            certify: self.certify.clone(),
            foreseen: self.foreseen.clone(),
            janson: self.janson.clone(),
        }
    }
}

/// The row of `section.name`.
pub fn row(key: &str) -> Option<Tunable> {
    let (section, name) = key.split_once('.')?;
    let table = Params::table().into_iter().find(|table| table.name == section)?;
    table.rows.into_iter().find(|row| row.name == name)
}

/// Every `section.name`, in order of declaration.
pub fn keys() -> Vec<String> {
    let table = Params::table();
    let names = |section: &SectionTable| {
        let prefix = section.name;
        section.rows.iter().map(|row| format!("{prefix}.{}", row.name)).collect::<Vec<_>>()
    };
    table.iter().flat_map(names).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_field_is_called_like_its_section() {
        let names: Vec<&str> = Params::table().iter().map(|section| section.name).collect();
        assert_eq!(names, FIELDS);
    }

    #[test]
    fn every_default_is_a_value_that_its_own_row_allows() {
        let mut params = Params::default();
        for key in keys() {
            let value = params.get(&key).unwrap_or_else(|| panic!("{key} has no value"));
            assert_eq!(value, row(&key).unwrap().default);
            params.set(&key, &value).unwrap_or_else(|error| panic!("{key} {error}"));
        }
        assert_eq!(params, Params::default());
    }

    #[test]
    fn every_parameter_has_a_text() {
        for section in Params::table() {
            assert!(section.text.ends_with('.'), "[{}]: {:?}", section.name, section.text);
            for row in section.rows {
                assert!(row.text.ends_with('.'), "{}.{}: {:?}", section.name, row.name, row.text);
            }
        }
    }

    #[test]
    fn names_outside_the_table_have_no_value() {
        let mut params = Params::default();
        for key in ["vehicle", "vehicle.", "vehicle.mass", "car.mass_kg", ""] {
            assert_eq!(params.get(key), None);
            assert_eq!(params.set(key, &Value::Real(1.0)), Err(TunableError::Unknown));
        }
    }
}
