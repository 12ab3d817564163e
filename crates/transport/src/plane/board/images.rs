//! Properties of each pixel from images of the board.
