"""Stress and plastic flow of jelly, rope and snow in three dimensions.

The equations are those of :mod:`.constitutive`, with the same signs and units per
length^3. Only ``+ - * /``, ``sqrt`` and comparisons are used, each a fixed number of
times, so that every processor returns the same bits.

A matrix is a list of its three rows. A symmetric matrix is a list of its entries in
Voigt's order: xx, yy, zz, yz, xz and xy. An entry is the number of one particle, or a
vector with the numbers of several particles. With vectors the processor computes these
particles at once; the bits are the same.

A deformation gradient F has the polar decomposition F = V R with the symmetric left
stretch V; V^2 = B = F F^T. With the signed principal stretches s1, s2, s3 (one is
negative where F inverts) the invariants of V are

    total = s1 + s2 + s3,    pairs = s1 s2 + s2 s3 + s3 s1,    J = s1 s2 s3 = det F.

The total is the largest root of the quartic

    (total^2 - tr B)^2 - 8 J total - 4 minors(B) = 0,

where ``minors`` is the sum of the principal minors. Newton's method starts at
sqrt(3 tr B), which is no smaller than the root, and descends to it. V then follows from
the theorem of Cayley and Hamilton:

    V = ((pairs + tr B) B + total J I - B^2) / (pairs total - J).

The stress needs V and B only: (F - R) F^T = B - V.

Sources: Markley 1993 (the quartic), Hoger and Carlson 1984 (the square root), Golub and
Van Loan (Jacobi's method), Stomakhin et al. 2012, 2013.
"""

from .constitutive import STRETCH_MIN, larger
from .language import f32, mat3, ti
from .transfer import Template, Value, bounded

# Newton steps: relative error of V within 2e-6 for stretches from 0.3 to 2.5
_NEWTON_STEPS = 6
# pairs of axes that a sweep rotates, one pair after the other
_AXIS_PAIRS = ((0, 1), (0, 2), (1, 2))
_AXES = (0, 1, 2)
# row and column of each entry of a symmetric matrix
_VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
# sweeps of Jacobi's method over the three pairs of axes
_SWEEPS = 4
# lower bound of two divisors: the derivative of the quartic, and
# pairs total - J = (s1 + s2) (s2 + s3) (s3 + s1)
_EPSILON = 1e-6


@ti.func
def rows_of(f: mat3) -> Value:
    """Return the matrix of one particle as a list of rows."""
    return [row_of(f, row) for row in ti.static(_AXES)]


@ti.func
def row_of(f: mat3, row: Template) -> Value:
    """Return a row of the matrix of one particle as a list."""
    return [f[row, column] for column in ti.static(_AXES)]


@ti.func
def dot(a: Template, b: Template) -> Value:
    """Return the dot product of two rows."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def times_transposed(rows: Template) -> Value:
    """Return M M^T, a symmetric matrix."""
    return [dot(rows[i], rows[j]) for i, j in ti.static(_VOIGT)]


@ti.func
def symmetric_square(b: Template) -> Value:
    """Return B^2 of a symmetric matrix, a symmetric matrix too."""
    xx, yy, zz, yz, xz, xy = b
    return times_transposed([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@ti.func
def times(b: Template, factor: Value) -> Value:
    """Return a symmetric matrix times a number."""
    return [factor * entry for entry in b]


@ti.func
def minus(a: Template, b: Template) -> Value:
    """Return the difference A - B of two symmetric matrices."""
    return [a[entry] - b[entry] for entry in ti.static(range(6))]


@ti.func
def plus_isotropic(b: Template, amount: Value) -> Value:
    """Return B + amount I of a symmetric matrix."""
    xx, yy, zz, yz, xz, xy = b
    return [xx + amount, yy + amount, zz + amount, yz, xz, xy]


@ti.func
def principal_minors(b: Template) -> Value:
    """Return the sum of the three principal minors of a symmetric matrix."""
    xx, yy, zz, yz, xz, xy = b
    return (xx * yy - xy * xy) + (yy * zz - yz * yz) + (xx * zz - xz * xz)


@ti.func
def determinant(rows: Template) -> Value:
    """Return det F, expanded along the first row."""
    xx, xy, xz = rows[0]
    yx, yy, yz = rows[1]
    zx, zy, zz = rows[2]
    return (
        xx * (yy * zz - yz * zy) - xy * (yx * zz - yz * zx) + xz * (yx * zy - yy * zx)
    )


@ti.func
def trace(b: Template) -> Value:
    """Return the sum of the diagonal of a symmetric matrix."""
    return b[0] + b[1] + b[2]


@ti.func
def stretch_sum(b: Template, jacobian: Value) -> Value:
    """Return the sum of the principal stretches, the largest root of the quartic."""
    b_trace = trace(b)
    linear_factor = 8.0 * jacobian
    constant_term = 4.0 * principal_minors(b)
    total = ti.sqrt(3.0 * b_trace)
    for _ in ti.static(range(_NEWTON_STEPS)):
        double_pairs = total * total - b_trace
        quartic = double_pairs * double_pairs - linear_factor * total - constant_term
        derivative = 4.0 * total * double_pairs - linear_factor
        total = total - quartic / larger(derivative, _EPSILON)
    return total


@ti.func
def left_stretch(b: Template, jacobian: Value) -> Value:
    """Return V of the polar decomposition F = V R, from B = F F^T and J = det F.

    Where two stretches are opposite, R is ambiguous. The result is then finite, but it
    is no stretch.
    """
    b_trace = trace(b)
    total = stretch_sum(b, jacobian)
    pairs = 0.5 * (total * total - b_trace)
    inverse = 1.0 / larger(pairs * total - jacobian, _EPSILON)
    # (pairs + tr B) B - B^2 + total J I
    without_identity = minus(times(b, pairs + b_trace), symmetric_square(b))
    return times(plus_isotropic(without_identity, total * jacobian), inverse)


@ti.func
def corotated_stress(rows: Template, mu: Value, la: Value) -> Value:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    It is symmetric. Lame's constants mu and lambda are in [mass/(length s^2)].
    """
    b = times_transposed(rows)
    jacobian = determinant(rows)
    volumetric = la * (jacobian - 1.0) * jacobian
    strain = minus(b, left_stretch(b, jacobian))
    return plus_isotropic(times(strain, 2.0 * mu), volumetric)


@ti.func
def follow_flow(rows: Template, gradient: Template, dt: f32) -> Value:
    """Return F of a solid after a substep, (I + dt C) F.

    Args:
        rows: F [1].
        gradient: the velocity gradient C [1/s].
        dt: duration of the substep [s].
    """
    columns = transposed(rows)
    return [
        add_rate(rows[row], dot_with_each(gradient[row], columns), dt)
        for row in ti.static(_AXES)
    ]


@ti.func
def add_rate(row: Template, rate: Template, dt: f32) -> Value:
    """Return row + dt rate; the rate is in [1/s]."""
    return [row[column] + dt * rate[column] for column in ti.static(_AXES)]


@ti.func
def rotation_tangent(difference: Value, double_entry: Value) -> Value:
    """Return the tangent of the angle by which Jacobi's method rotates two axes.

    After the rotation of the axes p and q the entry b_pq is 0. With d = b_qq - b_pp the
    tangent is

        2 b_pq / (d + sign(d) sqrt(d^2 + 4 b_pq^2)),

    and 0 where the divisor is 0: the matrix is diagonal there.

    Args:
        difference: d.
        double_entry: 2 b_pq.
    """
    root = ti.sqrt(difference * difference + double_entry * double_entry)
    divisor = difference + ti.select(difference < 0.0, -root, root)
    is_diagonal = divisor == 0.0
    tangent = double_entry / ti.select(is_diagonal, 1.0, divisor)
    return ti.select(is_diagonal, 0.0, tangent)


@ti.func
def rotated(
    p_component: Value, q_component: Value, cosine: Value, sine: Value
) -> Value:
    """Return two components after the axes p and q were rotated."""
    return (
        cosine * p_component - sine * q_component,
        sine * p_component + cosine * q_component,
    )


@ti.func
def principal_axes(b: Template) -> Value:
    """Return the eigenvalues of a symmetric matrix, and its eigenvectors.

    Jacobi's method rotates one pair of axes at a time, so that the off-diagonal entry
    of the pair becomes 0. A sweep rotates the three pairs; there are four sweeps.
    """
    xx, yy, zz, yz, xz, xy = b
    diagonal = [xx, yy, zz]
    # Entry r is the off-diagonal entry of the two other axes.
    off_diagonal = [yz, xz, xy]
    zero = 0.0 * xx
    one = zero + 1.0
    axes = [[one, zero, zero], [zero, one, zero], [zero, zero, one]]
    for _ in ti.static(range(_SWEEPS)):
        for p, q in ti.static(_AXIS_PAIRS):
            r = ti.static(3 - p - q)  # the third axis
            entry_pq = off_diagonal[r]
            tangent = rotation_tangent(diagonal[q] - diagonal[p], 2.0 * entry_pq)
            cosine = 1.0 / ti.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine

            shift = tangent * entry_pq
            diagonal[p] = diagonal[p] - shift
            diagonal[q] = diagonal[q] + shift
            off_diagonal[r] = zero
            new_pr, new_qr = rotated(off_diagonal[q], off_diagonal[p], cosine, sine)
            off_diagonal[q] = new_pr
            off_diagonal[p] = new_qr
            for row in ti.static(_AXES):
                new_p, new_q = rotated(axes[p][row], axes[q][row], cosine, sine)
                axes[p][row] = new_p
                axes[q][row] = new_q
    return diagonal, axes


@ti.func
def transposed(rows: Template) -> Value:
    """Return the rows of the transposed matrix."""
    return [column_of(rows, column) for column in ti.static(_AXES)]


@ti.func
def column_of(rows: Template, column: Template) -> Value:
    """Return a column of a matrix as a list."""
    return [rows[row][column] for row in ti.static(_AXES)]


@ti.func
def dot_with_each(row: Template, rows: Template) -> Value:
    """Return the dot products of a row with three rows."""
    return [dot(row, rows[other]) for other in ti.static(_AXES)]


@ti.func
def clamp_ratios(square: Value, low: f32, high: f32) -> Value:
    """Return clamped over trial stretch, and trial over clamped stretch.

    ``square`` is the squared trial stretch, an eigenvalue of B.
    """
    trial = larger(ti.sqrt(larger(square, 0.0)), STRETCH_MIN)
    clamped = bounded(trial, low, high)
    return clamped / trial, trial / clamped


@ti.func
def elastic_row(
    i: Template, ratios: Template, q_rows: Template, f_columns: Template
) -> Value:
    """Return row i of the elastic gradient Q diag(ratios) Q^T F."""
    scaled = [ratios[axis] * q_rows[i][axis] for axis in ti.static(_AXES)]
    stretch_row = dot_with_each(scaled, q_rows)  # of Q diag(ratios) Q^T
    return dot_with_each(stretch_row, f_columns)


@ti.func
def plastic_return(rows: Template, low: f32, high: f32) -> Value:
    """Clamp the principal stretches of the trial gradient F to [low, high].

    The columns of Q are the principal axes of B = F F^T. The elastic gradient is
    Q diag(ratios) Q^T F, where a ratio is clamped over trial stretch. The limits are
    1 - theta_c and 1 + theta_s. Stretches are taken as positive, and as no smaller than
    :data:`.constitutive.STRETCH_MIN`: those of snow lie near 1.

    Returns:
        The rows of the elastic gradient, and the factor on Jp: the product of trial
        over clamped stretches.
    """
    squares, axes = principal_axes(times_transposed(rows))
    ratio_1, growth_1 = clamp_ratios(squares[0], low, high)
    ratio_2, growth_2 = clamp_ratios(squares[1], low, high)
    ratio_3, growth_3 = clamp_ratios(squares[2], low, high)
    ratios = [ratio_1, ratio_2, ratio_3]
    q_rows = transposed(axes)
    f_columns = transposed(rows)
    elastic_rows = [elastic_row(i, ratios, q_rows, f_columns) for i in ti.static(_AXES)]
    return elastic_rows, growth_1 * growth_2 * growth_3
