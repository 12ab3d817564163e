//! The accounting in a session's ledger.

use std::collections::BTreeSet;
use std::path::Path;

use super::Findings;

/// Frames that are not accounted for, and points that are stored twice.
pub fn audit(session: &Path) -> Findings {
    let path = session.join("ledger.jsonl");
    match std::fs::read_to_string(&path) {
        Ok(text) => faults(&text).into_iter().map(|fault| format!("{}: {fault}", path.display())).collect(),
        Err(error) => vec![format!("{}: {error}", path.display())],
    }
}

fn faults(ledger: &str) -> Findings {
    let mut findings = Findings::new();
    let mut points = BTreeSet::new();
    for (number, line) in (1..).zip(ledger.lines()) {
        if let Some(counts) = object_after(line, "\"counts\":") {
            let frames = |key: &str| number_after(counts, key).unwrap_or(0);
            let lost: u64 = object_after(counts, "\"lost\":").map_or(0, |lost| {
                lost.split(',')
                    .filter_map(|cause| cause.rsplit(':').next()?.trim_matches('}').parse::<u64>().ok())
                    .sum()
            });
            let known = frames("\"averaged\":") + frames("\"settling\":") + frames("\"cancelled\":") + lost;
            let expected = frames("\"expected\":");
            if known != expected {
                findings.push(format!("line {number}: {known} of {expected} frames are accounted for"));
            }
        }
        if line.starts_with("{\"event\":\"point\"") {
            let point = line.split_once("\"attempt\"").map_or(line, |(point, _)| point);
            if !points.insert(point) {
                findings.push(format!("line {number}: a point is stored again"));
            }
        }
    }
    findings
}

/// The object that follows a key, up to its closing brace.
fn object_after<'a>(text: &'a str, key: &str) -> Option<&'a str> {
    let object = text.split_once(key)?.1;
    let mut depth = 0;
    let end = object.find(|brace| {
        depth += i32::from(brace == '{') - i32::from(brace == '}');
        brace == '}' && depth == 0
    })?;
    object.get(..=end)
}

fn number_after(text: &str, key: &str) -> Option<u64> {
    text.split_once(key)?.1.split(|digit: char| !digit.is_ascii_digit()).next()?.parse().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_and_points_are_counted() {
        let point = |index: u32, averaged: u32, lost: &str| {
            format!(
                "{{\"event\":\"point\",\"array\":\"sum\",\"index\":{index},\"attempt\":0,\"counts\":{{\"expected\":12,\
                 \"averaged\":{averaged},\"settling\":1,\"cancelled\":0,\"lost\":{{{lost}}}}},\"crc32\":99}}\n"
            )
        };
        let lost = "\"edge_missing\":2,\"camera_gap\":1";
        assert!(faults(&(point(1, 8, lost) + &point(2, 11, ""))).is_empty());
        assert_eq!(faults(&(point(1, 9, lost) + &point(1, 11, ""))).len(), 2);
    }
}
