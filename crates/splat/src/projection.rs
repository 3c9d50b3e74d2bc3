//! Projection of one Gaussian and its vector-Jacobian product (VJP): the formulas of the rasteriser.
//!
//! Every function here is compiled twice from this one source: as plain Rust for the CPU and, through CubeCL's
//! `#[cube]`, into the GPU kernels. Notation: `v_x` is ∂L/∂x for the scalar loss L.
//!
//! # Projection
//! With the camera's rotation R, its centre c, the Gaussian's mean μ, unit quaternion q and standard deviations s:
//!
//! * t = R·(μ − c). The subtraction comes first and c is kept as an unevaluated sum of two f32: for a scene far from
//!   the origin R·μ + T would cancel, μ − c does not.
//! * u = f ⊙ (t_x, t_y)/t_z + principal point; depth = t_z.
//! * m = J·R·R(q)·diag(s), the 2×3 projected square root of the covariance, with J = ∂u/∂t where t_x/t_z and t_y/t_z
//!   are clamped to the image border plus 15 % of its size.
//! * Σ' = m·mᵀ + ε·I = [[a, b], [b, c]].
//!
//! # Inverse of Σ' without cancellation
//! For a needle a·c − b² loses every digit in f32. With n = m₀ × m₁ (the cross product of m's rows) Lagrange's identity
//! gives det(m·mᵀ) = |n|², hence det Σ' = |n|² + ε(|m₀|² + |m₁|²) + ε², a sum of squares. The quadratic form is
//! evaluated in factored form,
//!
//! dᵀ Σ'⁻¹ d = (l₀·d_x)² + (l₁·(d_y + k·d_x))²,  l₀ = 1/√a, k = −b/a, l₁ = √(a/det Σ'),
//!
//! which cannot become negative, so the argument of exp is never positive. All of it is computed from m divided by
//! its largest entry where that exceeds one pixel, so that no square overflows.
//!
//! # Gradients of a splat
//! α = min(α_max, o·exp(−½·dᵀΛd)) with Λ = Σ'⁻¹ = FᵀF, F = [[l₀, 0], [l₁·k, l₁]] and d = pixel − u. Let
//! g = ∂L/∂α·α (zero where α is clamped) and w = F·d, so that the power is −½|w|². Then ∂power/∂u = Λd = Fᵀw and
//! ∂power/∂Σ' = ½·(Λd)(Λd)ᵀ, and a splat's gradients follow from five sums over pixels, r = Σ g·w and S = Σ g·w·wᵀ:
//! v_u = Fᵀ·r, v_m = 2·v_Σ'·m = Fᵀ·S·(F·m); and v_o = Σ g/o.
//! F·m is bounded by 1 for every shape of the splat, because (F·m)(F·m)ᵀ = 1 − ε·F·Fᵀ; its second row
//! l₁·(m₁ + k·m₀) would cancel for a needle, but equals l₁·(n × m₀ + ε·m₁)/a, which does not.
//!
//! # Gradient of a pixel
//! With e_i = c_i·v_colour + t_z,i·v_depth + v_alpha, the pixel's part of the loss is Σ α_i T_i e_i, hence
//! ∂L/∂α_i = T_i·e_i − (Σ_{j>i} α_j T_j e_j)/(1 − α_i).
//! Splats are visited back to front, so the bracket is a running sum and T_i = T_{i+1}/(1 − α_i).

use bytemuck::NoUninit;
use cubecl::prelude::*;

use crate::linear::{
    Mat3, Quat, Vec3, combine, cross, dot, multiply, product, rotation_matrix, times, transposed_product,
    transposed_times,
};

/// A camera as the rasteriser uses it.
#[derive(CubeType, Clone, Copy, Debug, NoUninit)]
#[repr(C)]
pub struct View {
    /// World → camera rotation.
    pub rotation: Mat3,
    /// Camera centre in the world, metres, rounded to f32 …
    pub centre: Vec3,
    /// … and the rounding error.
    pub centre_rest: Vec3,
    /// Focal lengths, pixels.
    pub fx: f32,
    pub fy: f32,
    /// Principal point, pixels.
    pub cx: f32,
    pub cy: f32,
    /// Limits of t_x/t_z and t_y/t_z at which J is linearised.
    pub x_min: f32,
    pub x_max: f32,
    pub y_min: f32,
    pub y_max: f32,
}

/// Values of a projected Gaussian that both passes need.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Projection {
    /// Mean in the camera's frame.
    pub t: Vec3,
    /// t_x/t_z, clamped for J.
    pub x: f32,
    /// t_y/t_z, clamped for J.
    pub y: f32,
    /// fx/t_z.
    pub jx: f32,
    /// fy/t_z.
    pub jy: f32,
    /// Unit quaternion.
    pub q: Quat,
    /// 1/|q|.
    pub q_inverse_norm: f32,
    /// R·R(q): its columns are the Gaussian's axes in the camera's frame.
    pub axes: Mat3,
    /// First row of m, divided by `unit`.
    pub m0: Vec3,
    /// Second row of m, divided by `unit`.
    pub m1: Vec3,
    /// max(1, largest entry of m), pixels.
    pub unit: f32,
    /// ε/unit².
    pub blur: f32,
}

/// A splat: a projected Gaussian, as the pixels use it.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Footprint {
    /// Centre, pixels.
    pub u: f32,
    pub v: f32,
    /// Factors of Σ'⁻¹: l₀, k and l₁ in the module's documentation.
    pub l0: f32,
    pub k: f32,
    pub l1: f32,
    /// √a: standard deviation along image x, pixels.
    pub sigma_x: f32,
    /// √c: standard deviation along image y, pixels.
    pub sigma_y: f32,
    /// √(det Σ'_raw / det Σ').
    pub compensation: f32,
    /// det Σ'/unit⁴; not positive where f32 cannot hold it.
    pub determinant: f32,
}

/// Sums over the pixels of one Gaussian in one view, from which the gradient of its projection follows.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct FootprintGradient {
    /// Σ g·w₀.
    pub r0: f32,
    /// Σ g·w₁.
    pub r1: f32,
    /// Σ g·w₀².
    pub s00: f32,
    /// Σ g·w₀·w₁.
    pub s01: f32,
    /// Σ g·w₁².
    pub s11: f32,
    /// ∂L/∂depth.
    pub depth: f32,
}

/// ∂L/∂(parameters) of one Gaussian.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct GaussianGradient {
    /// ∂L/∂mean.
    pub mean: Vec3,
    /// ∂L/∂rotation, through the normalisation.
    pub rotation: Quat,
    /// ∂L/∂scale.
    pub scale: Vec3,
}

/// Mean in the camera's frame.
#[cube]
pub fn to_camera(view: &View, mean: &Vec3) -> Vec3 {
    let d = Vec3 {
        x: (mean.x - view.centre.x) - view.centre_rest.x,
        y: (mean.y - view.centre.y) - view.centre_rest.y,
        z: (mean.z - view.centre.z) - view.centre_rest.z,
    };
    times(&view.rotation, &d)
}

/// Projects a Gaussian whose camera depth t_z is positive and whose quaternion is not zero.
#[cube]
pub fn project(view: &View, t: &Vec3, rotation: &Quat, scale: &Vec3, blur: f32) -> Projection {
    let x = (t.x / t.z).max(view.x_min).min(view.x_max);
    let y = (t.y / t.z).max(view.y_min).min(view.y_max);
    let jx = view.fx / t.z;
    let jy = view.fy / t.z;

    // Divided by the largest component first: the square of a huge or tiny quaternion leaves f32's range.
    let largest = rotation.w.abs().max(rotation.x.abs()).max(rotation.y.abs().max(rotation.z.abs()));
    let p = Quat {
        w: rotation.w / largest,
        x: rotation.x / largest,
        y: rotation.y / largest,
        z: rotation.z / largest,
    };
    let norm = (p.w * p.w + p.x * p.x + p.y * p.y + p.z * p.z).sqrt();
    let q = Quat { w: p.w / norm, x: p.x / norm, y: p.y / norm, z: p.z / norm };

    let axes = product(&view.rotation, &rotation_matrix(&q));
    let m0 = multiply(jx, &combine(1.0, &axes.r0, -x, &axes.r2), scale);
    let m1 = multiply(jy, &combine(1.0, &axes.r1, -y, &axes.r2), scale);
    let first = m0.x.abs().max(m0.y.abs()).max(m0.z.abs());
    let second = m1.x.abs().max(m1.y.abs()).max(m1.z.abs());
    let unit = first.max(second).max(1.0);
    Projection {
        t: Vec3 { x: t.x, y: t.y, z: t.z },
        x,
        y,
        jx,
        jy,
        q,
        q_inverse_norm: 1.0 / (norm * largest),
        axes,
        m0: Vec3 { x: m0.x / unit, y: m0.y / unit, z: m0.z / unit },
        m1: Vec3 { x: m1.x / unit, y: m1.y / unit, z: m1.z / unit },
        unit,
        blur: blur / unit / unit,
    }
}

/// The splat of a projected Gaussian.
#[cube]
pub fn footprint(view: &View, p: &Projection) -> Footprint {
    let n = cross(&p.m0, &p.m1);
    let raw = dot(&n, &n);
    let p00 = dot(&p.m0, &p.m0);
    let p11 = dot(&p.m1, &p.m1);
    let determinant = raw + p.blur * (p00 + p11) + p.blur * p.blur;
    let a = p00 + p.blur;
    let c = p11 + p.blur;
    let sqrt_a = a.sqrt();
    Footprint {
        u: p.jx * p.t.x + view.cx,
        v: p.jy * p.t.y + view.cy,
        l0: 1.0 / (p.unit * sqrt_a),
        k: -(dot(&p.m0, &p.m1) / a),
        l1: sqrt_a / (determinant.sqrt() * p.unit),
        sigma_x: sqrt_a * p.unit,
        sigma_y: c.sqrt() * p.unit,
        compensation: (raw / determinant).sqrt(),
        determinant,
    }
}

/// Range of x of an ellipse within a horizontal strip of the image.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Span {
    /// Least x, relative to the ellipse's centre, pixels.
    pub left: f32,
    /// Largest x.
    pub right: f32,
}

/// The range of x of the ellipse dᵀΛd ≤ `radius_squared` within the strip `top` ≤ d_y ≤ `bottom`, which it meets.
///
/// The ellipse's rightmost point is (r/l₀, −k·r/l₀). If it is outside of the strip, the rightmost point within the
/// strip is on the nearer edge: at d_y = e the boundary is A·x² + 2·l₁²k·e·x + l₁²e² − r² = 0 with A = l₀² + l₁²k²,
/// so x = (−l₁²k·e ± √(r²A − (l₀l₁e)²))/A; for e = −k·r/l₀ this is r/l₀ again. The left end is computed alike.
#[cube]
pub fn span(l0: f32, k: f32, l1: f32, radius_squared: f32, top: f32, bottom: f32) -> Span {
    let b = l1 * k;
    let a = l0 * l0 + b * b;
    let tip = k * (radius_squared.sqrt() / l0);
    let right_at = (-tip).max(top).min(bottom);
    let left_at = tip.max(top).min(bottom);
    let right_root = l0 * l1 * right_at;
    let left_root = l0 * l1 * left_at;
    // Just beyond the ellipse's top or bottom rounding may leave a negative number.
    let right_square = (radius_squared * a - right_root * right_root).max(0.0);
    let left_square = (radius_squared * a - left_root * left_root).max(0.0);
    Span {
        left: (-(b * l1 * left_at) - left_square.sqrt()) / a,
        right: (right_square.sqrt() - b * l1 * right_at) / a,
    }
}

/// VJP of the projection.
///
/// * Centre and covariance: v_u = Fᵀ·r and v_m = Fᵀ·S·(F·m), see the module.
/// * Compensation ρ = |n|/√D with n = m₀ × m₁, D = |n|² + ε(|m₀|² + |m₁|²) + ε²: with the part of D that does not come
///   from n, E = D − |n|², v_n = v_ρ·E/D^{3/2}·n/|n|, which stays bounded as n → 0 (where the unit vector, and with it
///   the gradient, is taken to be zero); v_m₀ += m₁ × v_n, v_m₁ += v_n × m₀, and through E: v_m += −v_ρ·ρ·ε/D·m.
///   ρ depends on m/unit only, so that unit counts as a constant.
/// * m's entry (0,k) = jx·(A₀ₖ − x·A₂ₖ)·sₖ with A = R·R(q); row 1 alike with y.
/// * jx = fx/t_z: ∂jx/∂t_z = −jx/t_z. x = t_x/t_z where it is not clamped; a clamped x is a constant.
/// * u = jx·t_x + cx.
/// * R(q) entry by entry; q = p/|p| gives v_p = (v_q − q·(q·v_q))/|p|.
///
/// `v_compensation` is zero without antialiasing.
#[cube]
pub fn project_vjp(
    view: &View,
    p: &Projection,
    scale: &Vec3,
    g: &FootprintGradient,
    v_compensation: f32,
) -> GaussianGradient {
    let f = footprint(view, p);
    let n = cross(&p.m0, &p.m1);
    // F·m and v_m = Fᵀ·S·(F·m).
    let a = dot(&p.m0, &p.m0) + p.blur;
    let across = cross(&n, &p.m0);
    let fm0 = Vec3 { x: f.l0 * p.unit * p.m0.x, y: f.l0 * p.unit * p.m0.y, z: f.l0 * p.unit * p.m0.z };
    let fm1 = combine(f.l1 * p.unit / a, &across, f.l1 * p.unit * p.blur / a, &p.m1);
    let q0 = combine(g.s00, &fm0, g.s01, &fm1);
    let q1 = combine(g.s01, &fm0, g.s11, &fm1);
    let from_shape0 = combine(f.l0, &q0, f.l1 * f.k, &q1);
    let v_u = f.l0 * g.r0 + f.l1 * f.k * g.r1;
    let v_v = f.l1 * g.r1;

    let raw = dot(&n, &n);
    let other = p.blur * (dot(&p.m0, &p.m0) + dot(&p.m1, &p.m1)) + p.blur * p.blur;
    let d = raw + other;
    let root = d.sqrt();
    let n_norm = raw.sqrt();
    // Divided step by step: the product of the divisors may underflow.
    let n_factor = select(n_norm > 0.0, v_compensation * (other / d) / root / n_norm.max(1e-30), 0.0);
    let m_factor = -(v_compensation * (n_norm / root) * p.blur / d);
    let v_n = Vec3 { x: n.x * n_factor, y: n.y * n_factor, z: n.z * n_factor };
    let through_n0 = cross(&p.m1, &v_n);
    let through_n1 = cross(&v_n, &p.m0);
    let ones = combine(1.0, &through_n0, m_factor, &p.m0);
    let twos = combine(1.0, &through_n1, m_factor, &p.m1);
    let v_m0 = combine(1.0, &from_shape0, 1.0 / p.unit, &ones);
    let v_m1 = combine(f.l1, &q1, 1.0 / p.unit, &twos);

    // Rows of J·A and their gradients, entry by entry.
    let h0 = combine(1.0, &p.axes.r0, -p.x, &p.axes.r2);
    let h1 = combine(1.0, &p.axes.r1, -p.y, &p.axes.r2);
    let v_scale = combine(1.0, &multiply(p.jx, &v_m0, &h0), 1.0, &multiply(p.jy, &v_m1, &h1));
    // v_h0/jx and v_h1/jy. The factors jx and jy are applied below.
    let w0 = multiply(1.0, &v_m0, scale);
    let w1 = multiply(1.0, &v_m1, scale);
    let v_jx = dot(&w0, &h0);
    let v_jy = dot(&w1, &h1);
    let v_axes = Mat3 {
        r0: Vec3 { x: p.jx * w0.x, y: p.jx * w0.y, z: p.jx * w0.z },
        r1: Vec3 { x: p.jy * w1.x, y: p.jy * w1.y, z: p.jy * w1.z },
        r2: combine(-(p.jx * p.x), &w0, -(p.jy * p.y), &w1),
    };
    let ratio_x = p.t.x / p.t.z;
    let ratio_y = p.t.y / p.t.z;
    let free_x = ratio_x >= view.x_min && ratio_x <= view.x_max;
    let free_y = ratio_y >= view.y_min && ratio_y <= view.y_max;
    let v_x = select(free_x, -(p.jx * dot(&w0, &p.axes.r2)), 0.0);
    let v_y = select(free_y, -(p.jy * dot(&w1, &p.axes.r2)), 0.0);

    let v_tx = v_u * p.jx + v_x / p.t.z;
    let v_ty = v_v * p.jy + v_y / p.t.z;
    let v_tz = g.depth
        - ((v_u * p.t.x + v_jx) * p.jx + (v_v * p.t.y + v_jy) * p.jy + v_x * ratio_x + v_y * ratio_y) / p.t.z;
    let v_mean = transposed_times(&view.rotation, &Vec3 { x: v_tx, y: v_ty, z: v_tz });

    let r = transposed_product(&view.rotation, &v_axes);
    let q = &p.q;
    let v_q = Quat {
        w: 2.0 * (q.x * (r.r2.y - r.r1.z) + q.y * (r.r0.z - r.r2.x) + q.z * (r.r1.x - r.r0.y)),
        x: 2.0
            * (q.y * (r.r0.y + r.r1.x) + q.z * (r.r0.z + r.r2.x) + q.w * (r.r2.y - r.r1.z)
                - 2.0 * q.x * (r.r1.y + r.r2.z)),
        y: 2.0
            * (q.x * (r.r0.y + r.r1.x) + q.z * (r.r1.z + r.r2.y) + q.w * (r.r0.z - r.r2.x)
                - 2.0 * q.y * (r.r0.x + r.r2.z)),
        z: 2.0
            * (q.x * (r.r0.z + r.r2.x) + q.y * (r.r1.z + r.r2.y) + q.w * (r.r1.x - r.r0.y)
                - 2.0 * q.z * (r.r0.x + r.r1.y)),
    };
    let along = q.w * v_q.w + q.x * v_q.x + q.y * v_q.y + q.z * v_q.z;
    let s = p.q_inverse_norm;
    GaussianGradient {
        mean: v_mean,
        rotation: Quat {
            w: (v_q.w - q.w * along) * s,
            x: (v_q.x - q.x * along) * s,
            y: (v_q.y - q.y * along) * s,
            z: (v_q.z - q.z * along) * s,
        },
        scale: v_scale,
    }
}
