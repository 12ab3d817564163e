//! What the stack says of itself, against what it was made with.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

mod common;

use common::{corner, ideal_stack, paper_sweep, photographed, timing};
use ndarray::{Array1, Array2, Array3, s};
use rand_distr::{Distribution, Uniform};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::plane::calibrate::*;
use raysweep_transport::plane::{Prior, RowModel, Setting, reach, reference};

/// The paper's sweep and twelve settings whose exposures begin or end within |u| <= 1.25.
fn edge_plan() -> Vec<Setting> {
    let edges_rows = [-1.25, -0.75, -0.25, 0.25, 0.75, 1.25];
    let edge = |side: f64| edges_rows.map(|edge_rows| Setting::new(side * 300.0 + edge_rows * 22.22, 600.0));
    paper_sweep().into_iter().chain(edge(-1.0)).chain(edge(1.0)).collect()
}

fn scene(light: impl Fn(f64, usize) -> f64) -> Array3<f32> {
    Array3::from_shape_fn((128, 128, 128), |(v, t, s)| light(v as f64 - t as f64, s) as f32)
}

/// Subsurface scattering: a quarter of white light direct, the rest in two wide, slightly lopsided tails.
fn wax() -> Array3<f32> {
    scene(|u, s| {
        let near = 0.02 * (-u.abs() / (6.0 + s as f64 / 13.0)).exp();
        let far = 0.004 * (-u.abs() / 30.0).exp() * (1.0 + 0.3 * u.signum());
        near + far + if u == 0.0 { 0.25 } else { 0.0 }
    })
}

/// Smooth light from about u = 0 and nothing that is direct.
fn no_direct_light() -> Array3<f32> {
    scene(|u, s| {
        let centre = 10.0 * (s as f64 / 20.0).sin();
        0.03 * (-((u - centre) / (15.0 + s as f64 / 13.0)).powi(2) / 2.0).exp()
    })
}

/// The corner with mirror-like glints: in a sixth of the pixels, a second spike up to 40 rows away.
fn glints() -> Array3<f32> {
    let mut transport = corner();
    let mut random = Xoshiro256PlusPlus::seed_from_u64(5);
    let (column, away) = (Uniform::new(0, 128).unwrap(), Uniform::new(-40_i32, 40).unwrap());
    let light = Uniform::new(0.1, 0.6).unwrap();
    for t in 0..128 {
        for _ in 0..20 {
            let v = (t as i32 + away.sample(&mut random)).clamp(0, 127) as usize;
            transport[[v, t, column.sample(&mut random)]] += light.sample(&mut random);
        }
    }
    transport
}

/// The scene with rectification off: direct light of row `t` lies at row `t + u0`, between two rows of the projector.
fn shifted(transport: &Array3<f32>, u0_rows: impl Fn(usize, usize) -> f64) -> Array3<f32> {
    Array3::from_shape_fn(transport.dim(), |(v, t, s)| {
        let u0 = u0_rows(t, s);
        let from = v.checked_add_signed(-(u0.signum() as isize)).filter(|&v| v < 128);
        let moved = from.map_or(0.0, |v| f64::from(transport[[v, t, s]]));
        ((1.0 - u0.abs()) * f64::from(transport[[v, t, s]]) + u0.abs() * moved) as f32
    })
}

fn gaussian(sigma_rows: f64) -> Vec<(i64, f64)> {
    let reach = (5.0 * sigma_rows).ceil() as i64;
    let share = |d: i64| if sigma_rows > 0.0 { (-(d as f64 / sigma_rows).powi(2) / 2.0).exp() } else { 1.0 };
    let total: f64 = (-reach..=reach).map(share).sum();
    (-reach..=reach).map(|d| (d, share(d) / total)).collect()
}

/// The light while each row is drawn, with a beam that reaches the rows about it.
fn under_beam(transport: &Array3<f32>, sigma_rows: f64) -> Array3<f32> {
    let mut spread = Array3::zeros(transport.dim());
    for (offset, share) in gaussian(sigma_rows) {
        for v in 0..128_i64 {
            if (0..128).contains(&(v + offset)) {
                let lit = transport.slice(s![(v + offset) as usize, .., ..]);
                spread.slice_mut(s![v as usize, .., ..]).scaled_add(share as f32, &lit);
            }
        }
    }
    spread
}

fn stack(transport: &Array3<f32>, settings: &[Setting], sigma_rows: f64) -> Array3<f32> {
    photographed(&ideal_stack(&under_beam(transport, sigma_rows), settings), 1)
}

fn sample(stack: &Array3<f32>, settings: &[Setting]) -> Sample {
    Sample::new(timing(), settings.to_vec(), stack.view(), None).unwrap()
}

/// Median relative l2 error of the profile over some pixels, solved by the reference with a beam and a place of direct
/// light, and the spike put where it was said to be.
fn profile_error(
    truth: &Array3<f32>,
    stack: &Array3<f32>,
    settings: &[Setting],
    prior: Prior,
    sigma_rows: f64,
    u0_rows: impl Fn(usize, usize) -> f64,
) -> f64 {
    let reach = reach(&timing(), settings).unwrap();
    let mut errors = Vec::new();
    for t in [20, 45, 64, 83, 108] {
        let slots = RowModel::new(&timing(), settings, &reach, t).slots;
        let differences = prior.differences(&slots);
        let own = slots.iter().position(|slot| slot.u == 0).unwrap();
        let ideal = |n: usize, u: i64| match (0..128).contains(&(t as i64 + u)) {
            true => timing().weight(u as i32, &settings[n]),
            false => 0.0,
        };
        let spread = Array2::from_shape_fn((settings.len(), slots.len()), |(n, slot)| {
            gaussian(sigma_rows).iter().map(|(d, share)| share * ideal(n, i64::from(slots[slot].u) - d)).sum::<f64>()
        });
        for s in (3..128).step_by(11) {
            let u0 = u0_rows(t, s);
            let neighbour = own.checked_add_signed(u0.signum() as isize).unwrap();
            let mut weights = spread.clone();
            let mixed = (1.0 - u0.abs()) * &spread.column(own) + u0.abs() * &spread.column(neighbour);
            weights.column_mut(own).assign(&mixed);
            let mut h = weights.t().dot(&weights) + prior.alpha() * differences.t().dot(&differences);
            h.diag_mut().mapv_inplace(|diagonal| diagonal * (1.0 + 1e-12));
            let samples = stack.slice(s![.., t, s]).mapv(f64::from);
            let c = weights.t().dot(&samples) - prior.beta() / 2.0;
            let mut x = Array1::from(reference::minimise(h.view(), &c.to_vec()));
            let spike = x[own];
            x[own] *= 1.0 - u0.abs();
            x[neighbour] += u0.abs() * spike;
            let true_profile: Array1<f64> =
                slots.iter().map(|slot| f64::from(truth[[(t as i32 + slot.u) as usize, t, s]])).collect();
            let error = &x - &true_profile;
            errors.push((error.dot(&error) / true_profile.dot(&true_profile)).sqrt());
        }
    }
    errors.sort_by(f64::total_cmp);
    errors[errors.len() / 2]
}

#[test]
fn experiments() {
    let scenes = [("corner", corner()), ("wax", wax()), ("glints", glints()), ("none", no_direct_light())];
        let plans = [("paper", paper_sweep()), ("edge", edge_plan())];
    let ms = |start: std::time::Instant| format!("{:.0} ms", start.elapsed().as_secs_f64() * 1e3);
    for (scene, transport) in &scenes {
        for (plan, settings) in &plans {
            let stack0 = stack(transport, settings, 0.0);
            let start = std::time::Instant::now();
            let sample0 = sample(&stack0, settings);
            let made = ms(start);
            let start = std::time::Instant::now();
            { let choice = choose_prior(&sample0, &Optics::default(), &candidates()).unwrap();
            println!("{scene} {plan} sample {made} prior {} {}", ms(start), choice.reason());
            for c in &choice.curve {
                println!("   {:?} {:.5} {:.3}±{:.3}", c.prior, c.residual, c.log_ratio, c.standard_error);
            } }
            for f in [0.0, 0.1, -0.5] {
                for sigma in [0.0, 0.7, 1.5] {
                    let stack = stack(&shifted(transport, |_, _| f), settings, sigma);
                    let sample = sample(&stack, settings);
                    let start = std::time::Instant::now();
                    let estimate = estimate_optics(&sample, None).unwrap();
                    let took = ms(start);
                    let beam = match estimate.beam.unwrap() {
                        Ok(b) => format!("{:.3}±{:.3}", b.sigma_rows, b.standard_error_rows),
                        Err(e) => e.to_string()[..50].to_owned(),
                    };
                    let spike = match estimate.spike {
                        Ok(m) => format!("{:.3}±{:.3} .. {:.3} ({})", m.u0[[64, 64]], m.standard_error[[64, 64]], m.u0[[5, 5]], m.pixels),
                        Err(e) => e.to_string()[..50].to_owned(),
                    };
                    println!("   f {f} sigma {sigma}: beam {beam} spike {spike} {took}");
                }
            }
        }
    }
}
