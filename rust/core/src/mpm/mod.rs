//! MLS-MPM solver and scenes.
