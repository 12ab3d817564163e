//! How long tests wait for what must come.

use std::time::Duration;

/// A test that has not come so far after this time hangs; a busy machine takes a minute.
pub const HUNG: Duration = Duration::from_secs(600);
