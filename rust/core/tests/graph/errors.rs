//! Every refusal names the argument, what came and what is accepted.

use adaptgns_core::Error;
use adaptgns_core::graph::{
    Expansion, Options, Particles, Radius, adaptive_graph, knn_graph, radius_graph,
};

const POSITIONS: [f64; 6] = [0.0, 0.0, 1.0, 0.0, 0.0, 1.0];

fn three() -> Particles<'static, f64> {
    Particles {
        positions: &POSITIONS,
        dim: 2,
        ptr: None,
        period: None,
    }
}

#[track_caller]
fn refused<R: std::fmt::Debug>(built: Result<R, Error>, message: &str) {
    let error = built.unwrap_err();
    assert!(matches!(error, Error::InvalidArgument { .. }));
    assert_eq!(error.to_string(), message);
}

fn radius(particles: &Particles<'_, f64>, radius: Radius<'_, f64>) -> Result<(), Error> {
    radius_graph(particles, radius, &Options::default()).map(|_| ())
}

#[test]
fn radii() {
    let accepted = "must be a finite number > 0 (whose square is a normal float64)";
    for r in [0.0, -0.1, f64::NAN, f64::INFINITY, 1e-200, 1e200] {
        refused(
            radius(&three(), Radius::Uniform(r)),
            &format!("r: got {r}, {accepted}"),
        );
        refused(
            radius(&three(), Radius::PerParticle(&[1.0, r, 1.0])),
            &format!("r: got {r}, {accepted}"),
        );
    }
    refused(
        radius(&three(), Radius::PerParticle(&[1.0])),
        "r: got 1 values for 3 particles, must be one per particle",
    );
}

#[test]
fn positions() {
    let with = |positions: &[f64], dim| {
        let particles = Particles {
            positions,
            dim,
            ..three()
        };
        radius(&particles, Radius::Uniform(1.0))
    };
    refused(
        with(&[0.0, f64::NAN], 2),
        "pos: got NaN at flat index 1, every value must be finite",
    );
    refused(
        with(&[0.0, 0.0, f64::NEG_INFINITY], 3),
        "pos: got -inf at flat index 2, every value must be finite",
    );
    for dim in [0, 1, 4] {
        refused(
            with(&[0.0; 8], dim),
            &format!("pos: got {dim} coordinates per particle, must be [N, 2] or [N, 3]"),
        );
    }
}

#[test]
fn batches() {
    for (ptr, problem) in [
        (&[][..], "got no offsets"),
        (&[1, 3], "starts at 1"),
        (&[0, 2], "ends at 2"),
        (&[0, 4], "ends at 4"),
        (&[0, 3, 2, 3], "falls from 3 to 2 at index 2"),
    ] {
        let particles = Particles {
            ptr: Some(ptr),
            ..three()
        };
        refused(
            radius(&particles, Radius::Uniform(1.0)),
            &format!("ptr: {problem}, must rise from 0 to the number of particles, 3"),
        );
    }
}

#[test]
fn boxes() {
    let with = |period: &[f64]| {
        let particles = Particles {
            period: Some(period),
            ..three()
        };
        radius(&particles, Radius::Uniform(1.0))
    };
    refused(with(&[1.0]), "box: got 1 lengths, must be 2, one per axis");
    for length in [-1.0, f64::NAN, f64::NEG_INFINITY] {
        refused(
            with(&[1.0, length]),
            &format!(
                "box: got the length {length}, must be a positive float64 or, \
                 for an open axis, inf or 0"
            ),
        );
    }
}

#[test]
fn expansions() {
    let good = Expansion {
        sigma: &[0.0, 1.0, 2.0],
        tau: 70.0,
        factor: 1.5,
        eligible: None,
    };
    let with = |expansion: Expansion<'_, f64>| {
        adaptive_graph(&three(), 1.0, &expansion, &Options::default())
    };
    for tau in [-1.0, 100.5, f64::NAN] {
        refused(
            with(Expansion { tau, ..good }),
            &format!("tau: got {tau}, must be a percentile in [0, 100]"),
        );
    }
    for factor in [0.99, f64::NAN, f64::INFINITY] {
        refused(
            with(Expansion { factor, ..good }),
            &format!("factor: got {factor}, must be a finite number >= 1"),
        );
    }
    refused(
        with(Expansion {
            factor: 1e200,
            ..good
        }),
        &format!(
            "factor * r: got {}, must be a finite number > 0 (whose square is a normal float64)",
            1e200
        ),
    );
    for value in [-1.0, f64::NAN, f64::INFINITY] {
        refused(
            with(Expansion {
                sigma: &[0.0, value, 1.0],
                ..good
            }),
            &format!("sigma: got {value} at flat index 1, every value must be finite and >= 0"),
        );
    }
    refused(
        with(Expansion {
            sigma: &[0.0],
            ..good
        }),
        "sigma: got 1 values for 3 particles, must be one per particle",
    );
    refused(
        with(Expansion {
            eligible: Some(&[true]),
            ..good
        }),
        "eligible: got 1 values for 3 particles, must be one per particle",
    );
}

#[test]
fn neighbour_counts() {
    for k in [0, 3, usize::MAX] {
        refused(
            knn_graph(&three(), k, &Options::default()),
            &format!(
                "k: got {k}, must be at least 1 and less than 3, the particles of the smallest graph"
            ),
        );
    }
    let far = Particles {
        positions: &[0.0_f32, 0.0, 1e19, 0.0],
        dim: 2,
        ptr: None,
        period: None,
    };
    refused(
        knn_graph(&far, 1, &Options::default()),
        "pos: spans 9999999980506448000, too far for squared distances in float32",
    );
}
