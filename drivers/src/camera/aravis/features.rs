//! The driver's interface to a GenICam feature map. Tests replace libaravis with a scripted camera here.

use std::ops::RangeInclusive;

use raysweep_core::{DeviceError, DeviceErrorKind};

/// A feature that could not be read, written or executed.
#[derive(Debug, thiserror::Error)]
#[error("feature {feature}: {what}")]
pub struct FeatureError {
    /// The feature's name.
    pub feature: String,
    /// The kind of failure.
    pub kind: DeviceErrorKind,
    /// What happened.
    pub what: String,
}

impl FeatureError {
    pub fn new(feature: &str, kind: DeviceErrorKind, what: impl Into<String>) -> Self {
        Self { feature: feature.to_owned(), kind, what: what.into() }
    }
}

impl From<FeatureError> for DeviceError {
    fn from(error: FeatureError) -> Self {
        DeviceError::new("camera", error.kind, error)
    }
}

pub type Result<T> = std::result::Result<T, FeatureError>;

/// A camera's features by name. Enumerations are read and written as text.
pub trait Features {
    /// Whether the feature exists and is available with the present settings.
    fn has(&self, name: &str) -> bool;
    fn float(&self, name: &str) -> Result<f64>;
    fn set_float(&self, name: &str, value: f64) -> Result<()>;
    fn float_range(&self, name: &str) -> Result<RangeInclusive<f64>>;
    fn integer(&self, name: &str) -> Result<i64>;
    fn set_integer(&self, name: &str, value: i64) -> Result<()>;
    fn integer_range(&self, name: &str) -> Result<RangeInclusive<i64>>;
    fn text(&self, name: &str) -> Result<String>;
    fn set_text(&self, name: &str, value: &str) -> Result<()>;
    /// The entries of an enumeration that are available now.
    fn choices(&self, name: &str) -> Result<Vec<String>>;
    fn boolean(&self, name: &str) -> Result<bool>;
    fn set_boolean(&self, name: &str, value: bool) -> Result<()>;
    fn execute(&self, name: &str) -> Result<()>;
    /// Sets a feature, or a register `R[address]`, given as `Name=Value`.
    fn set_line(&self, line: &str) -> Result<()>;
}

/// The first of these names under which the camera has the feature.
pub fn first_present(features: &impl Features, names: &[&'static str]) -> Option<&'static str> {
    names.iter().copied().find(|name| features.has(name))
}

/// Sets an enumeration and verifies it.
pub fn put_text(features: &impl Features, name: &str, value: &str) -> Result<()> {
    features.set_text(name, value).map_err(|mut error| {
        if let Ok(choices) = features.choices(name) {
            error.what =
                format!("{value:?} was refused ({}): must be one of {}", error.what, choices.join(", "));
        }
        error
    })?;
    took(name, value, &features.text(name)?)
}

/// Sets an integer and verifies it.
pub fn put_integer(features: &impl Features, name: &str, value: i64) -> Result<()> {
    let range = features.integer_range(name)?;
    if !range.contains(&value) {
        let what = format!("{value} was asked for: must be from {} to {}", range.start(), range.end());
        return Err(FeatureError::new(name, DeviceErrorKind::OutOfRange, what));
    }
    features.set_integer(name, value)?;
    took(name, &value, &features.integer(name)?)
}

/// Sets a boolean and verifies it.
pub fn put_boolean(features: &impl Features, name: &str, value: bool) -> Result<()> {
    features.set_boolean(name, value)?;
    took(name, &value, &features.boolean(name)?)
}

fn took<T: PartialEq + std::fmt::Debug + ?Sized>(name: &str, asked: &T, read: &T) -> Result<()> {
    if asked == read {
        return Ok(());
    }
    let what = format!("was set to {asked:?} and reads {read:?}: the camera takes another value only");
    Err(FeatureError::new(name, DeviceErrorKind::OutOfRange, what))
}

#[cfg(test)]
pub mod scripted {
    //! A camera made of a table: records all writes in order.

    use std::cell::RefCell;
    use std::collections::BTreeMap;

    use super::*;

    #[derive(Debug, Clone, PartialEq)]
    pub enum Value {
        Float(f64, RangeInclusive<f64>),
        Integer(i64, RangeInclusive<i64>),
        Text(String, Vec<&'static str>),
        Boolean(bool),
        Command,
    }

    #[derive(Default)]
    pub struct Scripted {
        pub values: RefCell<BTreeMap<String, Value>>,
        /// Every write, as `Name=Value`, in order.
        pub written: RefCell<Vec<String>>,
        /// Step size of floats, so that values differ when read back.
        pub step: f64,
    }

    impl Scripted {
        pub fn with(self, name: &str, value: Value) -> Self {
            self.values.borrow_mut().insert(name.into(), value);
            self
        }

        pub fn with_text(self, name: &str, choices: &[&'static str]) -> Self {
            self.with(name, Value::Text(choices[0].into(), choices.to_vec()))
        }

        pub fn take_written(&self) -> Vec<String> {
            std::mem::take(&mut self.written.borrow_mut())
        }

        fn get(&self, name: &str) -> Result<Value> {
            let value = self.values.borrow().get(name).cloned();
            value.ok_or_else(|| FeatureError::new(name, DeviceErrorKind::Unsupported, "is not there"))
        }

        fn put(&self, name: &str, shown: String, value: Value) -> Result<()> {
            self.get(name)?;
            self.written.borrow_mut().push(format!("{name}={shown}"));
            self.values.borrow_mut().insert(name.into(), value);
            Ok(())
        }

        fn wrong<T>(name: &str) -> Result<T> {
            Err(FeatureError::new(name, DeviceErrorKind::Protocol, "is of another type"))
        }
    }

    impl Features for Scripted {
        fn has(&self, name: &str) -> bool {
            self.values.borrow().contains_key(name)
        }

        fn float(&self, name: &str) -> Result<f64> {
            if let Value::Float(value, _) = self.get(name)? { Ok(value) } else { Self::wrong(name) }
        }

        fn set_float(&self, name: &str, value: f64) -> Result<()> {
            let Value::Float(_, range) = self.get(name)? else { return Self::wrong(name) };
            let stepped = if self.step > 0.0 { (value / self.step).round() * self.step } else { value };
            self.put(name, value.to_string(), Value::Float(stepped, range))
        }

        fn float_range(&self, name: &str) -> Result<RangeInclusive<f64>> {
            if let Value::Float(_, range) = self.get(name)? { Ok(range) } else { Self::wrong(name) }
        }

        fn integer(&self, name: &str) -> Result<i64> {
            if let Value::Integer(value, _) = self.get(name)? { Ok(value) } else { Self::wrong(name) }
        }

        fn set_integer(&self, name: &str, value: i64) -> Result<()> {
            let Value::Integer(_, range) = self.get(name)? else { return Self::wrong(name) };
            self.put(name, value.to_string(), Value::Integer(value, range))
        }

        fn integer_range(&self, name: &str) -> Result<RangeInclusive<i64>> {
            if let Value::Integer(_, range) = self.get(name)? { Ok(range) } else { Self::wrong(name) }
        }

        fn text(&self, name: &str) -> Result<String> {
            if let Value::Text(value, _) = self.get(name)? { Ok(value) } else { Self::wrong(name) }
        }

        fn set_text(&self, name: &str, value: &str) -> Result<()> {
            let Value::Text(_, choices) = self.get(name)? else { return Self::wrong(name) };
            if !choices.contains(&value) {
                return Err(FeatureError::new(name, DeviceErrorKind::OutOfRange, "no such entry"));
            }
            self.put(name, value.into(), Value::Text(value.into(), choices))
        }

        fn choices(&self, name: &str) -> Result<Vec<String>> {
            let Value::Text(_, choices) = self.get(name)? else { return Self::wrong(name) };
            Ok(choices.into_iter().map(str::to_owned).collect())
        }

        fn boolean(&self, name: &str) -> Result<bool> {
            if let Value::Boolean(value) = self.get(name)? { Ok(value) } else { Self::wrong(name) }
        }

        fn set_boolean(&self, name: &str, value: bool) -> Result<()> {
            self.put(name, value.to_string(), Value::Boolean(value))
        }

        fn execute(&self, name: &str) -> Result<()> {
            self.put(name, String::new(), Value::Command)
        }

        fn set_line(&self, line: &str) -> Result<()> {
            self.written.borrow_mut().push(line.into());
            Ok(())
        }
    }
}
