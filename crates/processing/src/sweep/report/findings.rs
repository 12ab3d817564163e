//! How the transport was estimated: properties of rig and scene found in the stack, and the held-out error of the
//! priors.

use raysweep_pipeline::{Findings, prior_name};
use raysweep_session::report::{Block, Section, Table};

use crate::report::remark;

/// The section about these findings.
pub(super) fn section(findings: &Findings) -> Section {
    let mut blocks: Vec<Block> = findings.remarks.iter().map(|(what, said)| remark(what, said)).collect();
    blocks.extend(curve(findings));
    if !findings.left_out_us.is_empty() {
        let row = |(delay_us, exposure_us): &(f64, f64)| {
            vec![format!("{delay_us:.1}"), format!("{exposure_us:.1}")]
        };
        blocks.push(Block::Table(Table {
            headers: vec!["left out: delay / µs".into(), "exposure / µs".into()],
            rows: findings.left_out_us.iter().map(row).collect(),
        }));
    }
    Section {
        title: "How it was demultiplexed".into(),
        intro: "Some images are held out and predicted from the others; the model that predicts them best is taken, the default in doubt.".into(),
        blocks,
    }
}

/// Held-out error of the priors.
fn curve(findings: &Findings) -> Option<Block> {
    let choice = findings.choice.as_ref()?;
    let row = |(index, candidate): (usize, &raysweep_transport::plane::calibrate::Candidate)| {
        // Errors are those of the logarithm, so that they agree with the reason above the table.
        let change = |errors: f64| {
            100.0 * (((candidate.log_ratio + errors * candidate.standard_error) / 2.0).exp() - 1.0)
        };
        vec![
            prior_name(candidate.prior),
            format!("{:.5}", candidate.residual),
            if index == 0 {
                "—".into()
            } else {
                format!("{:+.1} % ({:+.1} to {:+.1})", change(0.0), change(-1.0), change(1.0))
            },
            if index == choice.chosen { "taken".into() } else { String::new() },
        ]
    };
    Some(Block::Table(Table {
        headers: vec![
            "prior".into(),
            "held-out residual".into(),
            "against the default (within one standard error)".into(),
            String::new(),
        ],
        rows: choice.curve.iter().enumerate().map(row).collect(),
    }))
}
