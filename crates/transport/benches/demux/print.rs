use raysweep_transport::plane::SimdLevel;
use serde_json::json;

use super::Figures;
use super::gemm::Peak;
use super::linear::Compared;
use super::peers::Peer;

/// One line for each method and case. `seconds` is the minimum of the repetitions, `ratio` the method's seconds over
/// raysweep's on the same stack, `gap` the largest relative distance from the least objective.
pub fn json_lines(measured: &[(Figures, Vec<Peer>)], compared: &[Compared], peak: &Peak) {
    for (figures, peers) in measured {
        let mut own = json!({
            "bench": "demux",
            "case": case(figures),
            "method": "raysweep",
            "seconds": figures.seconds_min,
            "ratio": 1.0,
            "gap": figures.accuracy.gap_largest,
            "figures": figures,
            "share_of_f32_peak": figures.useful_flops_per_second() / peak.f32_flops,
            "share_of_f64_peak": figures.useful_flops_per_second() / peak.f64_flops,
        });
        if let Some(small) = same_problem_smaller(figures, measured) {
            own["times_the_small_case"] = json!(figures.seconds_min / small.seconds_min);
        }
        println!("{own}");
        for peer in peers {
            println!(
                "{}",
                json!({
                    "bench": "demux",
                    "case": case(figures),
                    "method": peer.method,
                    "seconds": peer.seconds,
                    "ratio": peer.seconds / figures.seconds_min,
                    "gap": peer.gap_largest,
                    "seconds_median": peer.seconds_median,
                    "gap_median": peer.gap_median,
                    "pixels_timed": peer.pixels_timed,
                })
            );
        }
    }
    for Compared { task, seconds, nalgebra_seconds, difference } in compared {
        for (method, seconds_taken) in [("raysweep", seconds), ("nalgebra", nalgebra_seconds)] {
            println!(
                "{}",
                json!({
                    "bench": "demux",
                    "case": task,
                    "method": method,
                    "seconds": seconds_taken,
                    "ratio": seconds_taken / seconds,
                    "difference": difference,
                })
            );
        }
    }
}

/// Prints the same as readable tables.
pub fn tables(measured: &[(Figures, Vec<Peer>)], compared: &[Compared], peak: &Peak) {
    let gflops = |flops: f64| format!("{:.0} GFLOP/s", flops / 1e9);
    println!(
        "{} threads; solved with {} where nothing else is said; GEMM peak {} in f32, {} in f64",
        rayon::current_num_threads(),
        SimdLevel::best().name(),
        gflops(peak.f32_flops),
        gflops(peak.f64_flops)
    );
    println!(
        "seconds: least and median of the repetitions; share of the peak: of what the answer itself asks for, A'I,"
    );
    println!(
        "H^-1 c and one confirmation of the rows that are zero, by the least seconds; steps with other rows and all"
    );
    println!("that is moved do not count; gap, error in T: against the f64 reference\n");
    println!(
        "{:<30} {:>3} {:>4} {:>7} {:>4} {:>8} {:>8} {:>9} {:>6} {:>6} {:>8} {:>8} {:>8} {:>8}",
        "case, prior",
        "N",
        "V",
        "pixels",
        "reps",
        "least s",
        "median s",
        "MFLOP/px",
        "of f32",
        "of f64",
        "checked",
        "gap max",
        "T median",
        "T max",
    );
    for (figures, _) in measured {
        let accuracy = &figures.accuracy;
        let percent = |peak: f64| format!("{:.1}%", 100.0 * figures.useful_flops_per_second() / peak);
        println!(
            "{:<30} {:>3} {:>4} {:>7} {:>4} {:>8.3} {:>8.3} {:>9.3} {:>6} {:>6} {:>8} {:>8.0e} {:>8.0e} {:>8.0e}",
            case(figures),
            figures.settings,
            figures.unknowns,
            figures.pixels,
            figures.repetitions,
            figures.seconds_min,
            figures.seconds_median,
            figures.useful_mflops_per_pixel,
            percent(peak.f32_flops),
            percent(peak.f64_flops),
            accuracy.pixels,
            accuracy.gap_largest,
            accuracy.error_median,
            accuracy.error_largest,
        );
    }
    println!();
    for (figures, _) in measured {
        if let Some(small) = same_problem_smaller(figures, measured) {
            println!(
                "{}: {:.1} times the time of {}, {} MiB of memory at most",
                case(figures),
                figures.seconds_min / small.seconds_min,
                small.case,
                figures.peak_memory_mib,
            );
        }
    }
    println!("\nlinear algebra on one thread, beside nalgebra in the same run; least of the repetitions");
    println!("{:<50} {:>8} {:>11} {:>7} {:>10}", "", "ms", "nalgebra ms", "ratio", "difference");
    for Compared { task, seconds, nalgebra_seconds, difference } in compared {
        let ratio = nalgebra_seconds / seconds;
        let [ms, nalgebra_ms] = [seconds, nalgebra_seconds].map(|seconds| 1e3 * seconds);
        println!("{task:<50} {ms:>8.3} {nalgebra_ms:>11.3} {ratio:>7.1} {difference:>10.0e}");
    }
    for (figures, peers) in measured.iter().filter(|(_, peers)| !peers.is_empty()) {
        println!(
            "\n{}: peers in the same run, scaled from the pixels timed; ratio of least seconds",
            case(figures)
        );
        println!(
            "{:<50} {:>8} {:>8} {:>7} {:>7} {:>10} {:>8}",
            "", "least s", "median s", "ratio", "pixels", "gap median", "gap max"
        );
        for peer in peers {
            println!(
                "{:<50} {:>8.2} {:>8.2} {:>7.1} {:>7} {:>10.0e} {:>8.0e}",
                peer.method,
                peer.seconds,
                peer.seconds_median,
                peer.seconds / figures.seconds_min,
                peer.pixels_timed,
                peer.gap_median,
                peer.gap_largest,
            );
        }
    }
}

fn case(figures: &Figures) -> String {
    let own = format!("{} {}", figures.case, figures.prior);
    match figures.instructions == SimdLevel::best().name() {
        true => own,
        false => format!("{own} {}", figures.instructions),
    }
}

/// The case with the same unknowns and prior but fewer pixels.
fn same_problem_smaller<'a>(of: &Figures, measured: &'a [(Figures, Vec<Peer>)]) -> Option<&'a Figures> {
    let mut all = measured.iter().map(|(figures, _)| figures);
    all.find(|it| it.unknowns == of.unknowns && it.prior == of.prior && it.pixels < of.pixels)
}
