//! The graph builders against brute force, against kiddo and on adversarial shapes.

mod errors;
mod oracle;
mod properties;
mod shapes;
