//! Collects what is found.

use raysweep_proto::{DoctorCheck, DoctorReport, Grade};

/// What was found so far.
#[derive(Debug, Default)]
pub(super) struct Checkup {
    checks: Vec<DoctorCheck>,
}

impl Checkup {
    /// As it should be.
    pub fn ok(&mut self, name: &str, found: impl Into<String>) {
        self.push(name, Grade::Ok, found.into(), None);
    }

    /// Not examined, and why.
    pub fn skipped(&mut self, name: &str, why: impl Into<String>) {
        self.push(name, Grade::Skipped, why.into(), None);
    }

    /// Runs are possible, but something will be lost or slow.
    pub fn warning(&mut self, name: &str, found: impl Into<String>, remedy: impl Into<String>) {
        self.push(name, Grade::Warning, found.into(), Some(remedy.into()));
    }

    /// Runs are impossible, or their data wrong.
    pub fn failure(&mut self, name: &str, found: impl Into<String>, remedy: impl Into<String>) {
        self.push(name, Grade::Failure, found.into(), Some(remedy.into()));
    }

    fn push(&mut self, name: &str, grade: Grade, found: String, remedy: Option<String>) {
        self.checks.push(DoctorCheck { name: name.into(), grade, found, remedy });
    }

    /// The report of what `user` examined.
    pub fn report(self, user: String) -> DoctorReport {
        DoctorReport { user, version: env!("CARGO_PKG_VERSION").into(), checks: self.checks }
    }

    #[cfg(test)]
    pub fn checks(&self) -> &[DoctorCheck] {
        &self.checks
    }
}
