//! New values of parameters for a running daemon.

use crate::params::Params;
use crate::tunable::{Change, TunableError, Value};

/// Why a parameter keeps its value.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum ChangeRefusal {
    /// There is none of that name, or the value is not allowed.
    #[error("{key} {error}")]
    Invalid {
        /// `section.name`.
        key: String,
        /// Why.
        error: TunableError,
    },
    /// The car is not at rest.
    #[error("{key} stays {kept}: {wanted} can take effect only at rest")]
    NotAtRest {
        /// `section.name`.
        key: String,
        /// The present value.
        kept: Value,
        /// The value asked for.
        wanted: Value,
    },
    /// The daemon must be started anew.
    #[error("{key} stays {kept}: {wanted} takes effect at the next start")]
    NextStart {
        /// `section.name`.
        key: String,
        /// The present value.
        kept: Value,
        /// The value asked for.
        wanted: Value,
    },
}

/// Parameters whose values differ between two sets: name, new value, and when that takes effect.
pub fn differences(old: &Params, new: &Params) -> Vec<(String, Value, Change)> {
    let mut found = Vec::new();
    for section in Params::table() {
        for row in &section.rows {
            let key = format!("{}.{}", section.name, row.name);
            if let Some(wanted) =
                new.get(&key).filter(|wanted| old.get(&key).as_ref() != Some(wanted))
            {
                found.push((key, wanted, row.change));
            }
        }
    }
    found
}

/// Stores one value if it may take effect now; says whether it differs from the one before.
pub fn apply(
    params: &mut Params,
    key: &str,
    value: &Value,
    at_rest: bool,
) -> Result<bool, ChangeRefusal> {
    let invalid = |error| ChangeRefusal::Invalid { key: key.to_owned(), error };
    let row = crate::params::row(key).ok_or_else(|| invalid(TunableError::Unknown))?;
    let wanted = row.check(value).map_err(invalid)?;
    let kept = params.get(key).ok_or_else(|| invalid(TunableError::Unknown))?;
    if wanted == kept {
        return Ok(false);
    }
    let key = key.to_owned();
    match row.change {
        Change::Restart => Err(ChangeRefusal::NextStart { key, kept, wanted }),
        Change::AtRest if !at_rest => Err(ChangeRefusal::NotAtRest { key, kept, wanted }),
        Change::AtRest | Change::Live => {
            params.set(&key, &wanted).expect("the value was checked");
            Ok(true)
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_value_waits_for_its_time() {
        let mut params = Params::default();
        let real = |v| Value::Real(v);
        assert_eq!(apply(&mut params, "speed.speed_max_mps", &real(2.0), false), Ok(true));
        assert_eq!(apply(&mut params, "speed.speed_max_mps", &real(2.0), false), Ok(false));
        let refused = apply(&mut params, "vehicle.friction", &real(0.5), false).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "vehicle.friction stays 0.9: 0.5 can take effect only at rest"
        );
        assert_eq!(apply(&mut params, "vehicle.friction", &real(0.5), true), Ok(true));
        let refused = apply(&mut params, "vehicle.mass_kg", &real(3.0), true).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "vehicle.mass_kg stays 2.5: 3.0 takes effect at the next start"
        );
        let refused = apply(&mut params, "speed.speed_max_mps", &real(99.0), true).unwrap_err();
        assert_eq!(refused.to_string(), "speed.speed_max_mps is 99.0, allowed is 0.1 to 20 m/s");
        assert!(apply(&mut params, "speed.sped", &real(1.0), true).is_err());
        assert_eq!(
            (params.speed.speed_max_mps, params.vehicle.friction, params.vehicle.mass_kg),
            (2.0, 0.5, 2.5)
        );
    }

    #[test]
    fn only_what_differs_is_found() {
        let (old, mut new) = (Params::default(), Params::default());
        assert!(differences(&old, &new).is_empty());
        new.speed.speed_max_mps = 1.5;
        new.vehicle.mass_kg = 3.0;
        assert_eq!(
            differences(&old, &new),
            [
                ("vehicle.mass_kg".to_owned(), Value::Real(3.0), Change::Restart),
                ("speed.speed_max_mps".to_owned(), Value::Real(1.5), Change::Live),
            ]
        );
    }
}
