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
# rows of an eigenvector
_ROWS = (0, 1, 2)
# sweeps of Jacobi's method over the three pairs of axes
_SWEEPS = 4
# lower bound of two divisors: the derivative of the quartic, and
# pairs total - J = (s1 + s2) (s2 + s3) (s3 + s1)
_EPSILON = 1e-6


@ti.func
def rows_of(f: mat3) -> Value:
    """Return the matrix of one particle as a list of rows."""
    x_row = row_of(f, 0)
    y_row = row_of(f, 1)
    z_row = row_of(f, 2)
    return [x_row, y_row, z_row]


@ti.func
def row_of(f: mat3, row: Template) -> Value:
    """Return a row of the matrix of one particle as a list."""
    x = f[row, 0]
    y = f[row, 1]
    z = f[row, 2]
    return [x, y, z]


@ti.func
def dot(a: Template, b: Template) -> Value:
    """Return the dot product of two rows."""
    a_x, a_y, a_z = a
    b_x, b_y, b_z = b
    return a_x * b_x + a_y * b_y + a_z * b_z


@ti.func
def times_transposed(rows: Template) -> Value:
    """Return M M^T, a symmetric matrix."""
    x = rows[0]
    y = rows[1]
    z = rows[2]
    xx = dot(x, x)
    yy = dot(y, y)
    zz = dot(z, z)
    yz = dot(y, z)
    xz = dot(x, z)
    xy = dot(x, y)
    return [xx, yy, zz, yz, xz, xy]


@ti.func
def symmetric_square(b: Template) -> Value:
    """Return B^2 of a symmetric matrix, a symmetric matrix too."""
    xx, yy, zz, yz, xz, xy = b
    x = [xx, xy, xz]
    y = [xy, yy, yz]
    z = [xz, yz, zz]
    rows = [x, y, z]
    return times_transposed(rows)


@ti.func
def times(b: Template, factor: Value) -> Value:
    """Return a symmetric matrix times a number."""
    xx, yy, zz, yz, xz, xy = b
    return [
        factor * xx,
        factor * yy,
        factor * zz,
        factor * yz,
        factor * xz,
        factor * xy,
    ]


@ti.func
def minus(a: Template, b: Template) -> Value:
    """Return the difference A - B of two symmetric matrices."""
    xx = a[0] - b[0]
    yy = a[1] - b[1]
    zz = a[2] - b[2]
    yz = a[3] - b[3]
    xz = a[4] - b[4]
    xy = a[5] - b[5]
    return [xx, yy, zz, yz, xz, xy]


@ti.func
def plus_isotropic(b: Template, amount: Value) -> Value:
    """Return B + amount I of a symmetric matrix."""
    b_xx, b_yy, b_zz, yz, xz, xy = b
    xx = b_xx + amount
    yy = b_yy + amount
    zz = b_zz + amount
    return [xx, yy, zz, yz, xz, xy]


@ti.func
def principal_minors(b: Template) -> Value:
    """Return the sum of the three principal minors of a symmetric matrix."""
    xx, yy, zz, yz, xz, xy = b
    # of each minor, the products along its main and along its other diagonal
    main_x = yy * zz
    main_z = xx * yy
    other_x = yz * yz
    other_y = xz * xz
    return main_z - xy * xy + (main_x - other_x) + (xx * zz - other_y)


@ti.func
def determinant(rows: Template) -> Value:
    """Return det F, expanded along the first row."""
    x_row, y_row, z_row = rows
    xx, xy, xz = x_row
    yx, yy, yz = y_row
    zx, zy, zz = z_row
    # of each minor, the products along its main and along its other diagonal
    other_z = yy * zx
    minor_x = yy * zz - yz * zy
    minor_y = yx * zz - yz * zx
    return xx * minor_x - xy * minor_y + xz * (yx * zy - other_z)


@ti.func
def trace(b: Template) -> Value:
    """Return the sum of the diagonal of a symmetric matrix."""
    xx = b[0]
    yy = b[1]
    zz = b[2]
    return (xx + yy) + zz


@ti.func
def stretch_sum(b: Template, jacobian: Value) -> Value:
    """Return the sum of the principal stretches, the largest root of the quartic."""
    b_trace = trace(b)
    minors = principal_minors(b)
    linear_factor = 8.0 * jacobian
    constant_term = 4.0 * minors
    total = ti.sqrt(3.0 * b_trace)
    for _ in ti.static(range(_NEWTON_STEPS)):
        double_pairs = total * total - b_trace
        leading_term = double_pairs * double_pairs
        quartic = leading_term - linear_factor * total - constant_term
        derivative = 4.0 * total * double_pairs - linear_factor
        divisor = larger(derivative, _EPSILON)
        total = total - quartic / divisor
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
    sum_product = pairs * total - jacobian
    divisor = larger(sum_product, _EPSILON)
    inverse = 1.0 / divisor
    # (pairs + tr B) B - B^2 + total J I
    b_factor = pairs + b_trace
    b_term = times(b, b_factor)
    b_square = symmetric_square(b)
    without_identity = minus(b_term, b_square)
    isotropic = total * jacobian
    numerator = plus_isotropic(without_identity, isotropic)
    return times(numerator, inverse)


@ti.func
def corotated_stress(rows: Template, mu: Value, la: Value) -> Value:
    """Return the fixed corotated stress 2 mu (F - R) F^T + lambda (J - 1) J I.

    It is symmetric. Lame's constants mu and lambda are in [mass/(length s^2)].
    """
    b = times_transposed(rows)
    jacobian = determinant(rows)
    volumetric = la * (jacobian - 1.0) * jacobian
    v = left_stretch(b, jacobian)
    strain = minus(b, v)
    double_mu = 2.0 * mu
    shear_stress = times(strain, double_mu)
    return plus_isotropic(shear_stress, volumetric)


@ti.func
def follow_flow(rows: Template, gradient: Template, dt: f32) -> Value:
    """Return F of a solid after a substep, (I + dt C) F.

    Args:
        rows: F [1].
        gradient: the velocity gradient C [1/s].
        dt: duration of the substep [s].
    """
    old_x_row, old_y_row, old_z_row = rows
    x_gradient, y_gradient, z_gradient = gradient
    columns = transposed(rows)
    x_rate = dot_with_each(x_gradient, columns)
    y_rate = dot_with_each(y_gradient, columns)
    z_rate = dot_with_each(z_gradient, columns)
    x_row = add_rate(old_x_row, x_rate, dt)
    y_row = add_rate(old_y_row, y_rate, dt)
    z_row = add_rate(old_z_row, z_rate, dt)
    return [x_row, y_row, z_row]


@ti.func
def add_rate(row: Template, rate: Template, dt: f32) -> Value:
    """Return row + dt rate; the rate is in [1/s]."""
    old_x, old_y, old_z = row
    x_rate, y_rate, z_rate = rate
    x = old_x + dt * x_rate
    y = old_y + dt * y_rate
    z = old_z + dt * z_rate
    return [x, y, z]


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
    new_p_component = cosine * p_component - sine * q_component
    new_q_component = sine * p_component + cosine * q_component
    return new_p_component, new_q_component


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
    x_axis = [one, zero, zero]
    y_axis = [zero, one, zero]
    z_axis = [zero, zero, one]
    axes = [x_axis, y_axis, z_axis]
    for _ in ti.static(range(_SWEEPS)):
        for p, q in ti.static(_AXIS_PAIRS):
            r = ti.static(3 - p - q)  # the third axis
            entry_pp = diagonal[p]
            entry_qq = diagonal[q]
            entry_pq = off_diagonal[r]
            difference = entry_qq - entry_pp
            double_entry = 2.0 * entry_pq
            tangent = rotation_tangent(difference, double_entry)
            cosine = 1.0 / ti.sqrt(tangent * tangent + 1.0)
            sine = tangent * cosine

            shift = tangent * entry_pq
            diagonal[p] = entry_pp - shift
            diagonal[q] = entry_qq + shift
            off_diagonal[r] = zero
            entry_pr = off_diagonal[q]
            entry_qr = off_diagonal[p]
            new_pr, new_qr = rotated(entry_pr, entry_qr, cosine, sine)
            off_diagonal[q] = new_pr
            off_diagonal[p] = new_qr
            for row in ti.static(_ROWS):
                p_entry = axes[p][row]
                q_entry = axes[q][row]
                new_p_entry, new_q_entry = rotated(p_entry, q_entry, cosine, sine)
                axes[p][row] = new_p_entry
                axes[q][row] = new_q_entry
    return diagonal, axes


@ti.func
def transposed(rows: Template) -> Value:
    """Return the rows of the transposed matrix."""
    x_column = column_of(rows, 0)
    y_column = column_of(rows, 1)
    z_column = column_of(rows, 2)
    return [x_column, y_column, z_column]


@ti.func
def column_of(rows: Template, column: Template) -> Value:
    """Return a column of a matrix as a list."""
    x_row, y_row, z_row = rows
    x = x_row[column]
    y = y_row[column]
    z = z_row[column]
    return [x, y, z]


@ti.func
def dot_with_each(row: Template, rows: Template) -> Value:
    """Return the dot products of a row with three rows."""
    x_row, y_row, z_row = rows
    x = dot(row, x_row)
    y = dot(row, y_row)
    z = dot(row, z_row)
    return [x, y, z]


@ti.func
def clamp_ratios(square: Value, low: f32, high: f32) -> Value:
    """Return clamped over trial stretch, and trial over clamped stretch.

    ``square`` is the squared trial stretch, an eigenvalue of B.
    """
    positive_square = larger(square, 0.0)
    root = ti.sqrt(positive_square)
    trial = larger(root, STRETCH_MIN)
    clamped = bounded(trial, low, high)
    ratio = clamped / trial
    growth = trial / clamped
    return ratio, growth


@ti.func
def elastic_row(
    i: Template, ratios: Template, q_rows: Template, f_columns: Template
) -> Value:
    """Return row i of the elastic gradient Q diag(ratios) Q^T F."""
    first_ratio, second_ratio, third_ratio = ratios
    q_first, q_second, q_third = q_rows[i]
    first = first_ratio * q_first
    second = second_ratio * q_second
    third = third_ratio * q_third
    scaled = [first, second, third]
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
    b = times_transposed(rows)
    squares, axes = principal_axes(b)
    square_1, square_2, square_3 = squares
    ratio_1, growth_1 = clamp_ratios(square_1, low, high)
    ratio_2, growth_2 = clamp_ratios(square_2, low, high)
    ratio_3, growth_3 = clamp_ratios(square_3, low, high)
    growth = growth_1 * growth_2 * growth_3
    ratios = [ratio_1, ratio_2, ratio_3]
    q_rows = transposed(axes)
    f_columns = transposed(rows)
    x_row = elastic_row(0, ratios, q_rows, f_columns)
    y_row = elastic_row(1, ratios, q_rows, f_columns)
    z_row = elastic_row(2, ratios, q_rows, f_columns)
    elastic_rows = [x_row, y_row, z_row]
    return elastic_rows, growth
