//! Log lines on standard error: with time and level for people; with priorities for systemd's journal, which has the
//! time itself (sd-daemon(3)).

use std::fmt;
use std::io::{IsTerminal, stderr};

use tracing::{Event, Level, Subscriber};
use tracing_subscriber::fmt::format::Writer;
use tracing_subscriber::fmt::{FmtContext, FormatEvent, FormatFields};
use tracing_subscriber::registry::LookupSpan;

/// Sends the log of this process to standard error.
pub fn log_to_stderr() {
    let log = tracing_subscriber::fmt().with_writer(stderr);
    if is_stderr() {
        log.with_ansi(false).event_format(JournalFormat).init();
    } else {
        log.with_target(false).with_ansi(stderr().is_terminal()).init();
    }
}

/// What a line about an error begins with on standard error.
pub fn error_prefix() -> String {
    if is_stderr() { prefix(Level::ERROR) } else { String::new() }
}

/// Whether standard error is the journal's stream, which `JOURNAL_STREAM` names (systemd.exec(5)).
fn is_stderr() -> bool {
    let Ok(stream) = std::env::var("JOURNAL_STREAM") else { return false };
    nix::sys::stat::fstat(stderr()).is_ok_and(|about| stream == format!("{}:{}", about.st_dev, about.st_ino))
}

/// The priority of syslog(3), as sd-daemon(3) writes it.
fn prefix(level: Level) -> String {
    let priority = match level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        Level::DEBUG | Level::TRACE => 7,
    };
    format!("<{priority}>")
}

/// Formats events for the journal: each line, because the journal takes each as an entry, has the priority.
struct JournalFormat;

impl<S, N> FormatEvent<S, N> for JournalFormat
where
    S: Subscriber + for<'a> LookupSpan<'a>,
    N: for<'a> FormatFields<'a> + 'static,
{
    fn format_event(
        &self,
        context: &FmtContext<'_, S, N>,
        mut writer: Writer<'_>,
        event: &Event<'_>,
    ) -> fmt::Result {
        let mut text = String::new();
        context.format_fields(Writer::new(&mut text), event)?;
        let prefix = prefix(*event.metadata().level());
        text.lines().try_for_each(|line| writeln!(writer, "{prefix}{line}"))
    }
}
