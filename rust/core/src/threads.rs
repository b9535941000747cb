//! Thread pools that stay alive in forked processes.
