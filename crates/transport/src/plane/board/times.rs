//! When each projector row is lit, from images of the white board.
