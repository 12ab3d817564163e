use std::collections::BTreeSet;

use ndarray::{ArrayView3, Axis, s};

use super::super::model::{RowModel, RowTiming, Setting, Slot, SlotKind, Transport};

/// Light as a function of the delay `t_d` at one exposure, by ascending delay.
#[derive(Debug, Clone, PartialEq)]
pub struct DelayProfile {
    /// Mean true delay of each image.
    pub delays_us: Vec<f64>,
    /// Mean light of the pixels in each image; 1.0 for a white surface under its own row.
    pub light: Vec<f64>,
}

impl DelayProfile {
    /// The mean of `pixels` (`[t, s]`, at least one) in the images of `stack`, `[settings, t, s]`.
    pub fn measured(stack: ArrayView3<f32>, settings: &[Setting], pixels: &[[usize; 2]]) -> Self {
        let mut sums = vec![0.0; settings.len()];
        Self::add_measured(&mut sums, stack, pixels);
        Self::mean(settings, &sums, pixels.len())
    }

    /// The profile that the forward model predicts from `transport`. Light of the next or the previous frame is not
    /// in the transport, and therefore not in the prediction.
    pub fn predicted(
        timing: &RowTiming,
        transport: &Transport,
        settings: &[Setting],
        pixels: &[[usize; 2]],
    ) -> Self {
        let mut sums = vec![0.0; settings.len()];
        Self::add_predicted(&mut sums, timing, 0, transport, settings, pixels);
        Self::mean(settings, &sums, pixels.len())
    }

    /// The mean of `pixels` whose light was summed by [`Self::add_measured`] or [`Self::add_predicted`], one sum for
    /// each setting.
    pub fn mean(settings: &[Setting], sums: &[f64], pixels: usize) -> Self {
        let light = sums.iter().map(|sum| sum / pixels as f64);
        let mut points: Vec<(f64, f64)> = settings.iter().map(Setting::mean_delay_us).zip(light).collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        let (delays_us, light) = points.into_iter().unzip();
        Self { delays_us, light }
    }

    /// Adds the light of `pixels` to the sums, in order: processing the camera rows in parts gives the same bits as
    /// processing all at once.
    pub fn add_measured(sums: &mut [f64], stack: ArrayView3<f32>, pixels: &[[usize; 2]]) {
        for (sum, image) in sums.iter_mut().zip(stack.axis_iter(Axis(0))) {
            pixels.iter().for_each(|&pixel| *sum += f64::from(image[pixel]));
        }
    }

    /// [`Self::add_measured`] for the prediction of the camera rows starting at `first_row`, to which `transport` and
    /// `pixels` refer.
    pub fn add_predicted(
        sums: &mut [f64],
        timing: &RowTiming,
        first_row: usize,
        transport: &Transport,
        settings: &[Setting],
        pixels: &[[usize; 2]],
    ) {
        let reach = transport.u_min..=transport.u_max();
        for of_row in pixels.chunk_by(|a, b| a[0] == b[0]) {
            let at = of_row[0][0];
            let columns = transport.t.len_of(Axis(2));
            let wanted: BTreeSet<usize> = of_row.iter().map(|&[_, s]| s).collect();
            for (model, mut columns) in RowModel::of_pixels(timing, settings, &reach, first_row + at, columns)
            {
                columns.retain(|s| wanted.contains(s));
                for (Slot { u, kind }, weights) in model.slots.iter().zip(model.weights.axis_iter(Axis(1))) {
                    if *kind == SlotKind::Own {
                        let profiles = transport.t.slice(s![(u - transport.u_min) as usize, at, ..]);
                        let of_slot: f64 = columns.iter().map(|&s| f64::from(profiles[s])).sum();
                        sums.iter_mut().zip(weights).for_each(|(sum, weight)| *sum += weight * of_slot);
                    }
                }
            }
        }
    }

    /// The profile divided by its area (trapezium rule), per microsecond: albedo and brightness cancel, as required
    /// for material recognition (the paper's Figure 11). NaN if the area is not positive.
    pub fn normalised_per_us(&self) -> Vec<f64> {
        let pieces = self.delays_us.windows(2).zip(self.light.windows(2));
        let area: f64 = pieces.map(|(us, light)| (us[1] - us[0]) * (light[0] + light[1]) / 2.0).sum();
        self.light.iter().map(|light| if area > 0.0 { light / area } else { f64::NAN }).collect()
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3};

    use super::super::super::{predict, relative_rows};
    use super::*;

    const PIXELS: [[usize; 2]; 3] = [[3, 0], [3, 1], [7, 1]];

    /// Out of order, and one of them the mean of two frames.
    fn settings() -> Vec<Setting> {
        let mut settings: Vec<Setting> =
            [120.0, -40.0, 0.0, 35.0].map(|delay_us| Setting::new(delay_us, 90.0)).into();
        settings[2].delays_us = vec![-3.0, 5.0];
        settings
    }

    fn scene() -> (RowTiming, Array3<f32>) {
        let timing = RowTiming::new(12, 20.0, 2000.0).unwrap();
        (timing, Array3::from_shape_fn((12, 12, 2), |(v, t, s)| ((7 * v + 5 * t + 3 * s) % 11) as f32))
    }

    #[test]
    fn the_prediction_is_the_forward_models_image_at_the_pixels() {
        let (timing, truth) = scene();
        let images: Vec<_> =
            settings().iter().map(|setting| predict(&timing, truth.view(), setting).unwrap()).collect();
        let views: Vec<_> = images.iter().map(|image| image.view()).collect();
        let stack = ndarray::stack(Axis(0), &views).unwrap();
        let measured = DelayProfile::measured(stack.view(), &settings(), &PIXELS);
        assert_eq!(measured.delays_us, [-40.0, 1.0, 35.0, 120.0]);
        let at = |image: &Array2<f32>| PIXELS.iter().map(|&pixel| f64::from(image[pixel])).sum::<f64>() / 3.0;
        assert_eq!(measured.light, [1, 2, 3, 0].map(|index: usize| at(&images[index])));

        let reach = -11..=11;
        let t = relative_rows(truth.view(), &reach);
        let transport = Transport::measured(t, -11, Array2::from_elem((23, 12), true));
        let predicted = DelayProfile::predicted(&timing, &transport, &settings(), &PIXELS);
        assert_eq!(predicted.delays_us, measured.delays_us);
        for (predicted, measured) in predicted.light.iter().zip(&measured.light) {
            assert!((predicted - measured).abs() < 1e-5 * measured, "{predicted} is not {measured}");
        }
    }

    #[test]
    fn the_area_of_a_normalised_profile_is_one_whatever_the_albedo() {
        let profile = |albedo: f64| DelayProfile {
            delays_us: vec![-100.0, 0.0, 50.0],
            light: [1.0, 3.0, 1.0].map(|light| albedo * light).into(),
        };
        // 100 us x 2 + 50 us x 2.
        assert_eq!(profile(1.0).normalised_per_us(), [1.0 / 300.0, 3.0 / 300.0, 1.0 / 300.0]);
        for (bright, dim) in
            profile(1.0).normalised_per_us().into_iter().zip(profile(0.25).normalised_per_us())
        {
            assert!((bright - dim).abs() < 1e-15);
        }
        assert!(profile(0.0).normalised_per_us().iter().all(|light| light.is_nan()));
    }
}
