//! The products that a plan names, as pictures and plots.

use ndarray::{ArrayView3, ArrayView4, Axis};
use raysweep_core::Mosaic;
use raysweep_pipeline::{CrossSection, Product, Profile, mask};
use raysweep_session::report::{Block, ContactSheet, Marker, Picture, Plot, Section, Series, ToneMap};

use crate::plane::colour::{Values, in_colour, mask_in_colour, sequence_in_colour};

/// Percentile of the pixels that maps to white in a picture.
pub(super) const PERCENTILE: f64 = 99.5;
/// Number of pictures of a sequence on a contact sheet.
const SHEET_PICTURES: usize = 12;
/// Number of pictures in the animation of a sequence; more would make the page too large.
const ANIMATION_PICTURES: usize = 48;

/// Section of the images, if there are any.
pub(super) fn images(products: &[Product], mosaic: Mosaic, markers: &[Marker]) -> Option<Section> {
    let pictures: Vec<Picture> = products
        .iter()
        .filter_map(|product| match product {
            Product::Image { name, about, is_light, image, mask } => {
                let bounds = mask_in_colour(mask.clone(), mosaic).mapv(|bits| bits & mask::BOUND_ONLY != 0);
                let values = if *is_light { Values::Light } else { Values::Errors };
                let image = in_colour(image.view(), mosaic, values);
                let tone_map = ToneMap::percentile(&image.axis_iter(Axis(2)).collect::<Vec<_>>(), PERCENTILE);
                let shown = Picture::coloured(image.view(), tone_map);
                Some(
                    shown
                        .with_caption(format!("{name}: {about}"))
                        .with_markers(markers.to_vec())
                        .with_hatching(bounds),
                )
            }
            _ => None,
        })
        .collect();
    (!pictures.is_empty()).then(|| Section {
        title: "Light by where it came from".into(),
        intro: "The projector draws its rows one after the other, so the camera can tell which row's light it sees. Light from the row that lights a pixel directly is at u = 0; u counts rows from there, and all other light was reflected or scattered on its way. Camera rows are t, columns are s. Each picture has its own scale; 1 is a white surface lit by its own projector row. The crosses are the pixels of the profiles below. Where pixels are hatched, the light is only known to be at least what is shown: they saturate.".into(),
        blocks: vec![Block::Pictures(pictures)],
    })
}

/// A section for each sequence: a contact sheet and an animation.
pub(super) fn sequences(products: &[Product], mosaic: Mosaic) -> impl Iterator<Item = Section> {
    products.iter().filter_map(move |product| match product {
        Product::Sequence { name, about, axis, at, images, .. } => {
            let images = sequence_in_colour(images.view(), mosaic);
            Some(sequence(name, about, axis, at, images.view()))
        }
        _ => None,
    })
}

fn sequence(name: &str, about: &str, axis: &str, at: &[f64], images: ArrayView4<'_, f32>) -> Section {
    let views: Vec<ArrayView3<'_, f32>> = images.outer_iter().collect();
    let planes: Vec<_> = views.iter().flat_map(|image| image.axis_iter(Axis(2))).collect();
    let tone_map = ToneMap::percentile(&planes, PERCENTILE);
    let shown = spread(at.len(), SHEET_PICTURES);
    let sheet = ContactSheet {
        column_title: axis.into(),
        columns: shown.iter().map(|&k| value(at[k])).collect(),
        row_title: String::new(),
        rows: vec![name.into()],
        pictures: shown.iter().map(|&k| Some(Picture::small(views[k], tone_map))).collect(),
    };
    let moving: Vec<_> = spread(views.len(), ANIMATION_PICTURES).into_iter().map(|k| views[k]).collect();
    let caption = format!("{} of {} images", moving.len(), views.len());
    let animation = Picture::animation(&moving, tone_map).map(|picture| picture.with_caption(caption));
    let few = if shown.len() < at.len() {
        format!(
            " {} of {} images are shown; products/{name}/contact_sheet.png has all.",
            shown.len(),
            at.len()
        )
    } else {
        String::new()
    };
    Section {
        title: format!("Sequence {name}"),
        intro: format!("{}.{few}", capitalised(about)),
        blocks: vec![Block::ContactSheet(sheet), Block::Pictures(animation.into_iter().collect())],
    }
}

/// A value of an axis, without the digits that only computing gives.
fn value(value: f64) -> String {
    let text = format!("{value:.1}");
    let text = text.strip_suffix(".0").unwrap_or(&text);
    if text == "-0" { "0".into() } else { text.into() }
}

/// At most `most` of `len` indices, evenly spaced, including the first and the last.
fn spread(len: usize, most: usize) -> Vec<usize> {
    let count = len.min(most);
    (0..count).map(|k| if count > 1 { k * (len - 1) / (count - 1) } else { k }).collect()
}

/// Section of the requested delay profiles, if there are any.
pub(super) fn profiles(products: &[Product]) -> Option<Section> {
    let profiles: Vec<&Profile> = products
        .iter()
        .filter_map(|product| match product {
            Product::Profile(profile) => Some(profile),
            _ => None,
        })
        .collect();
    let points = |profile: &Profile, values: &[f64]| {
        profile.measured.delays_us.iter().copied().zip(values.iter().copied()).collect::<Vec<_>>()
    };
    let plot = |title: String, y_label: &str, series| Plot {
        title,
        x_label: "delay t_d / µs".into(),
        y_label: y_label.into(),
        series,
        guides: Vec::new(),
    };
    let each = profiles.iter().map(|profile| {
        let series = vec![
            Series::line("measured", points(profile, &profile.measured.light)),
            Series::line("predicted from the transport", points(profile, &profile.predicted.light)),
        ];
        plot(format!("{}, {} µs", profile.name, profile.exposure_us), "light", series)
    });
    let together = profiles.iter().map(|profile| {
        Series::line(profile.name.as_str(), points(profile, &profile.measured.normalised_per_us()))
    });
    let together = plot("All, each over its area".into(), "light / area / µs⁻¹", together.collect());
    let about = profiles.iter().map(|profile| format!("{}: {}.", profile.name, profile.about));
    (!profiles.is_empty()).then(|| Section {
        title: "Delay profiles".into(),
        intro: format!(
            "{} Over its area a profile no longer depends on albedo.",
            about.collect::<Vec<_>>().join(" ")
        ),
        blocks: vec![Block::Plots(each.chain([together]).collect())],
    })
}

/// Section of the requested cross-sections, if there are any.
pub(super) fn cross_sections(products: &[Product]) -> Option<Section> {
    let sections: Vec<&CrossSection> = products
        .iter()
        .filter_map(|product| match product {
            Product::CrossSection(section) => Some(section),
            _ => None,
        })
        .collect();
    let plot = |section: &CrossSection| {
        let pixels = |curve: &[f64]| (0..curve.len()).map(|pixel| pixel as f64).zip(curve.to_vec()).collect();
        Plot {
            title: section.name.clone(),
            x_label: format!("{} / pixels", section.along),
            y_label: "light".into(),
            series: section.curves.iter().map(|(name, curve)| Series::line(*name, pixels(curve))).collect(),
            guides: Vec::new(),
        }
    };
    let about = sections.iter().map(|section| format!("{}: {}.", section.name, section.about));
    (!sections.is_empty()).then(|| Section {
        title: "Cross-sections".into(),
        intro: about.collect::<Vec<_>>().join(" "),
        blocks: vec![Block::Plots(sections.iter().map(|section| plot(section)).collect())],
    })
}

fn capitalised(sentence: &str) -> String {
    let mut letters = sentence.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().chain(letters).collect())
}
