//! What clients want a running viewfinder to show.

use std::sync::{Mutex, MutexGuard, PoisonError};

use raysweep_core::{CameraCapabilities, FinderPicture};
use raysweep_proto::{ErrorCode, RpcError, ViewfinderParams};

/// Changes wanted of a run's viewfinder and not yet made. Closed, unless the run is one.
#[derive(Default)]
pub struct WantedLook(Mutex<Option<ViewfinderParams>>);

/// The run is no viewfinder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NoViewfinder;

impl WantedLook {
    fn lock(&self) -> MutexGuard<'_, Option<ViewfinderParams>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Accepts changes from now on.
    pub fn open(&self) {
        self.lock().get_or_insert_default();
    }

    /// Adds changes; later ones replace earlier ones.
    ///
    /// # Errors
    /// If the run is no viewfinder.
    pub fn change(&self, wanted: &ViewfinderParams) -> Result<(), NoViewfinder> {
        let mut look = self.lock();
        let waiting = look.as_mut().ok_or(NoViewfinder)?;
        let ViewfinderParams { picture, region, exposure_us, delay_us } = wanted;
        waiting.picture = picture.or(waiting.picture);
        waiting.region = region.or(waiting.region);
        waiting.exposure_us = exposure_us.or(waiting.exposure_us);
        waiting.delay_us = delay_us.or(waiting.delay_us);
        Ok(())
    }

    /// The changes to make; none, if all are made.
    pub fn take(&self) -> ViewfinderParams {
        self.lock().as_mut().map(std::mem::take).unwrap_or_default()
    }

    /// Whether changes wait to be made.
    pub fn is_changed(&self) -> bool {
        self.lock().as_ref().is_some_and(|waiting| *waiting != ViewfinderParams::default())
    }
}

/// Checks whether the rig can show what is wanted.
///
/// # Errors
/// `InvalidParams`, with the field.
pub fn check_look(
    wanted: &ViewfinderParams,
    camera: &CameraCapabilities,
    is_dot_rig: bool,
) -> Result<(), RpcError> {
    let invalid = |field, what: String| Err(RpcError::new(ErrorCode::InvalidParams, what).of_field(field));
    if is_dot_rig && wanted.picture == Some(FinderPicture::Align) {
        let what =
            "picture = \"align\": a dot rig has no rows to align; allowed: white, black, grid, rows, cross";
        return invalid("picture", what.into());
    }
    let (rows, columns) = (camera.height, camera.width);
    if let Some(region @ [top, bottom, left, right]) = wanted.region
        && !(top < bottom && bottom <= rows && left < right && right <= columns)
    {
        let what = format!(
            "region = {region:?}: give [first row, row after the last, first column, column after the last] within {rows} rows and {columns} columns"
        );
        return invalid("region", what);
    }
    if let Some(delay_us) = wanted.delay_us.filter(|delay_us| is_dot_rig || !delay_us.is_finite()) {
        let allowed = if is_dot_rig { "a dot rig has no delays: leave it out" } else { "give a number" };
        return invalid("delay_us", format!("delay_us = {delay_us}: {allowed}"));
    }
    let allowed = &camera.exposure_us;
    match wanted.exposure_us.filter(|exposure_us| !allowed.contains(exposure_us)) {
        None => Ok(()),
        Some(exposure_us) => invalid(
            "exposure_us",
            format!("exposure_us = {exposure_us}: the camera takes {} to {}", allowed.start(), allowed.end()),
        ),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn changes_wait_for_a_viewfinder_and_later_ones_replace_earlier_ones() {
        let look = WantedLook::default();
        let picture = |picture| ViewfinderParams { picture: Some(picture), ..ViewfinderParams::default() };
        assert_eq!(look.change(&picture(FinderPicture::Grid)), Err(NoViewfinder));
        look.open();
        assert!(!look.is_changed());
        look.change(&picture(FinderPicture::Grid)).unwrap();
        look.change(&ViewfinderParams { exposure_us: Some(5.0), ..ViewfinderParams::default() }).unwrap();
        look.change(&picture(FinderPicture::Rows)).unwrap();
        assert!(look.is_changed());
        let wanted = ViewfinderParams { exposure_us: Some(5.0), ..picture(FinderPicture::Rows) };
        assert_eq!((look.take(), look.take()), (wanted, ViewfinderParams::default()));
    }
}
