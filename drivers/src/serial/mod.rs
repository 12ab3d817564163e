//! Controllers on serial lines: the port, and replies among the bytes received from it.

pub(crate) mod patience;
pub(crate) mod port;
pub mod wire;
