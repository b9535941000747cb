//! Small dense matrices of constant size.

/// A row-major `D`×`D` matrix.
pub(crate) type Matrix<const D: usize> = [[f64; D]; D];

pub(crate) const fn zero<const D: usize>() -> Matrix<D> {
    [[0.0; D]; D]
}

pub(crate) fn identity<const D: usize>() -> Matrix<D> {
    diagonal(&[1.0; D])
}

pub(crate) fn diagonal<const D: usize>(values: &[f64; D]) -> Matrix<D> {
    let mut matrix = zero();
    for (k, &value) in values.iter().enumerate() {
        matrix[k][k] = value;
    }
    matrix
}

pub(crate) fn trace<const D: usize>(a: &Matrix<D>) -> f64 {
    (0..D).map(|k| a[k][k]).sum()
}

pub(crate) fn dot<const D: usize>(a: &[f64; D], b: &[f64; D]) -> f64 {
    (0..D).map(|k| a[k] * b[k]).sum()
}

/// Determinant of a symmetric positive definite matrix, whose elimination needs no
/// pivoting.
pub(crate) fn determinant<const D: usize>(matrix: &Matrix<D>) -> f64 {
    let mut a = *matrix;
    for pivot in 0..D {
        for i in pivot + 1..D {
            let factor = a[i][pivot] / a[pivot][pivot];
            for j in pivot..D {
                a[i][j] -= factor * a[pivot][j];
            }
        }
    }
    (0..D).map(|k| a[k][k]).product()
}

/// `a b aᵀ`.
pub(crate) fn congruence<const D: usize>(a: &Matrix<D>, b: &Matrix<D>) -> Matrix<D> {
    let mut ab = zero();
    for i in 0..D {
        for j in 0..D {
            ab[i][j] = (0..D).map(|k| a[i][k] * b[k][j]).sum();
        }
    }
    let mut result = zero();
    for i in 0..D {
        for j in 0..D {
            result[i][j] = dot(&ab[i], &a[j]);
        }
    }
    result
}

/// Eigenvalues, and the matrix whose columns are the eigenvectors, of a symmetric
/// matrix, by cyclic Jacobi rotations: exact after one rotation for `D` = 2, and
/// quadratically convergent for `D` = 3.
pub(crate) fn symmetric_eigen<const D: usize>(matrix: &Matrix<D>) -> ([f64; D], Matrix<D>) {
    const MAX_SWEEPS: usize = 12;
    let mut a = *matrix;
    let mut vectors = identity();
    let scale: f64 = (0..D).map(|k| a[k][k].abs()).sum();
    for _ in 0..MAX_SWEEPS {
        let mut rotated = false;
        for p in 0..D {
            for q in p + 1..D {
                if a[p][q].abs() > f64::EPSILON * 1e-2 * scale {
                    rotate(&mut a, &mut vectors, p, q);
                    rotated = true;
                }
            }
        }
        if !rotated || D == 2 {
            break;
        }
    }
    (std::array::from_fn(|k| a[k][k]), vectors)
}

/// The rotation in the plane (p, q) that zeroes `a[p][q]`, by the smaller of the two
/// possible angles.
fn rotate<const D: usize>(a: &mut Matrix<D>, vectors: &mut Matrix<D>, p: usize, q: usize) {
    let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
    let tangent = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let cosine = 1.0 / (tangent * tangent + 1.0).sqrt();
    let sine = tangent * cosine;
    for row in a.iter_mut().chain(vectors.iter_mut()) {
        let (x, y) = (row[p], row[q]);
        row[p] = cosine * x - sine * y;
        row[q] = sine * x + cosine * y;
    }
    for k in 0..D {
        let (x, y) = (a[p][k], a[q][k]);
        a[p][k] = cosine * x - sine * y;
        a[q][k] = sine * x + cosine * y;
    }
    a[p][q] = 0.0;
    a[q][p] = 0.0;
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check<const D: usize>(matrix: Matrix<D>) {
        let (values, vectors) = symmetric_eigen(&matrix);
        let rebuilt = congruence(&vectors, &diagonal(&values));
        let gram = congruence(&vectors, &identity());
        for i in 0..D {
            for j in 0..D {
                assert!((rebuilt[i][j] - matrix[i][j]).abs() < 1e-13, "{matrix:?}");
                assert!((gram[i][j] - f64::from(i == j)).abs() < 1e-14, "{matrix:?}");
            }
        }
        let product: f64 = values.iter().product();
        assert!((determinant(&matrix) - product).abs() < 1e-14, "{matrix:?}");
    }

    #[test]
    fn eigen_decomposition_rebuilds_the_matrix() {
        check([[2.0, 0.3], [0.3, 1.0]]);
        check([[1.0, 0.0], [0.0, 1.0]]);
        check([[1.0, 1e-9], [1e-9, 1.0]]);
        check([[1.2, 0.1, -0.4], [0.1, 0.7, 0.2], [-0.4, 0.2, 1.1]]);
        check([[1.0, 0.5, 0.5], [0.5, 1.0, 0.5], [0.5, 0.5, 1.0]]);
        check([[3.0, 0.0, 0.0], [0.0, 1.0, 1e-12], [0.0, 1e-12, 1.0]]);
    }
}
