//! A small dot rig and its plan.

/// A rig file for a moving V-groove of 112 x 128 pixels, with a margin of 16 rows for the trailing dot; `more` is
/// appended.
pub fn rig(more: &str) -> String {
    format!(
        "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
         [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n{more}"
    )
}

/// A plan of 300 dots per batch, 20 batches per second, with two planes; `more` is inserted before its tables.
pub fn plan(more: &str, batches: u32) -> String {
    format!(
        "kind = \"batches\"\n{more}\n[batches]\ncount = {batches}\ndots = 300\nexposure_us = 100\ndark_frames = 64\n\
         trailing_region = [112, 128, 48, 80]\nbackground_indices = [0]\n\
         [batches.path]\nshape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]\nsamples = 1500\nrate_hz = 30000\n\
         [[batches.calibration]]\nbatches = 2\n[[batches.calibration]]\nbatches = 2\n"
    )
}
