//! Functions with equal results on every machine. The standard sine differs between systems in the last digits.

use std::f32::consts::PI;

use glam::{Mat3, Vec2, Vec3};

/// Right-handed rotations by degrees.
pub fn rotate_x(degrees: f32) -> Mat3 {
    let (s, c) = libm::sincosf(degrees * PI / 180.0);
    Mat3::from_cols(Vec3::X, Vec3::new(0.0, c, s), Vec3::new(0.0, -s, c))
}

pub fn rotate_y(degrees: f32) -> Mat3 {
    let (s, c) = libm::sincosf(degrees * PI / 180.0);
    Mat3::from_cols(Vec3::new(c, 0.0, -s), Vec3::Y, Vec3::new(s, 0.0, c))
}

pub fn rotate_z(degrees: f32) -> Mat3 {
    let (s, c) = libm::sincosf(degrees * PI / 180.0);
    Mat3::from_cols(Vec3::new(c, s, 0.0), Vec3::new(-s, c, 0.0), Vec3::Z)
}

/// 0 below `from`, 1 above `to`, smooth in between.
pub fn smoothstep(from: f32, to: f32, x: f32) -> f32 {
    let t = ((x - from) / (to - from)).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

/// The smaller of two distances, with a smooth transition where they differ by less than `radius`.
pub fn smooth_min(a: f32, b: f32, radius: f32) -> f32 {
    let overlap = (radius - (a - b).abs()).max(0.0) / radius;
    a.min(b) - overlap * overlap * radius / 4.0
}

/// Hash of a lattice point, in [0, 1).
pub fn hash(x: i32, y: i32, z: i32, seed: u32) -> f32 {
    let mut h = seed.wrapping_mul(0x9e37_79b9);
    for v in [x, y, z] {
        h = (h ^ v as u32).wrapping_mul(0x85eb_ca6b);
        h ^= h >> 13;
        h = h.wrapping_mul(0xc2b2_ae35);
        h ^= h >> 16;
    }
    (h >> 8) as f32 / (1 << 24) as f32
}

/// Value noise in [0, 1] on a lattice of unit spacing.
pub fn noise(p: Vec3, seed: u32) -> f32 {
    let cell = p.floor();
    let f = p - cell;
    let w = f * f * (Vec3::splat(3.0) - 2.0 * f);
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let along_x = |dy: i32, dz: i32| {
        let (a, b) = (hash(x, y + dy, z + dz, seed), hash(x + 1, y + dy, z + dz, seed));
        a + (b - a) * w.x
    };
    let along_y = |dz: i32| {
        let (a, b) = (along_x(0, dz), along_x(1, dz));
        a + (b - a) * w.y
    };
    let (a, b) = (along_y(0), along_y(1));
    a + (b - a) * w.z
}

/// Value noise on a plane.
pub fn noise2(p: Vec2, seed: u32) -> f32 {
    noise(p.extend(0.5), seed)
}
