//! Controllers on serial lines: the port, and replies among the bytes received from it.

pub(crate) mod port;
pub(crate) mod timeout;
pub mod wire;
