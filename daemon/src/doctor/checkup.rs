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

    /// Not examined, though every run depends on it, so that it is not passed. If one of the checks that it needs has
    /// failed, that is to be mended first.
    pub fn unexamined(&mut self, name: &str, needs: &[&str], why: &str, remedy: impl Into<String>) {
        let mut failed = self.checks.iter().filter(|check| check.grade == Grade::Failure);
        match failed.find(|check| needs.contains(&check.name.as_str())) {
            Some(DoctorCheck { name: first, .. }) => {
                let why = format!("not examined: mend {first} first");
                self.skipped(name, why);
            }
            None => self.failure(name, format!("not examined: {why}"), remedy),
        }
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_could_not_be_examined_is_not_passed() {
        let mut checkup = Checkup::default();
        checkup.warning("frames", "few", "more");
        checkup.unexamined("delay", &["frames"], "no frames", "look");
        checkup.failure("edges", "none", "wire");
        checkup.unexamined("ties", &["edges"], "no edges", "look");
        let grades: Vec<Grade> = checkup.checks().iter().map(|check| check.grade).collect();
        assert_eq!(grades, [Grade::Warning, Grade::Failure, Grade::Failure, Grade::Skipped]);
        assert!(checkup.checks()[3].found.contains("mend edges first"), "{:?}", checkup.checks());
    }
}
