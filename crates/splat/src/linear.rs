//! Small vectors and matrices, compiled for the CPU and, through CubeCL's `#[cube]`, into the GPU kernels.

use bytemuck::NoUninit;
use cubecl::CubeTypeMut;
use cubecl::prelude::*;

/// A vector.
#[derive(CubeType, CubeTypeMut, Clone, Copy, Debug, NoUninit)]
#[repr(C)]
pub struct Vec3 {
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

/// Quaternion in (w, x, y, z) order.
#[derive(CubeType, Clone, Copy, Debug)]
pub struct Quat {
    pub w: f32,
    pub x: f32,
    pub y: f32,
    pub z: f32,
}

/// A 3×3 matrix, row by row.
#[derive(CubeType, Clone, Copy, Debug, NoUninit)]
#[repr(C)]
pub struct Mat3 {
    pub r0: Vec3,
    pub r1: Vec3,
    pub r2: Vec3,
}

/// a·b.
#[cube]
pub fn dot(a: &Vec3, b: &Vec3) -> f32 {
    a.x * b.x + a.y * b.y + a.z * b.z
}

/// a × b.
#[cube]
pub fn cross(a: &Vec3, b: &Vec3) -> Vec3 {
    Vec3 { x: a.y * b.z - a.z * b.y, y: a.z * b.x - a.x * b.z, z: a.x * b.y - a.y * b.x }
}

/// f·a + g·b.
#[cube]
pub fn combine(f: f32, a: &Vec3, g: f32, b: &Vec3) -> Vec3 {
    Vec3 { x: f * a.x + g * b.x, y: f * a.y + g * b.y, z: f * a.z + g * b.z }
}

/// f·a·b, component by component.
#[cube]
pub fn multiply(f: f32, a: &Vec3, b: &Vec3) -> Vec3 {
    Vec3 { x: f * a.x * b.x, y: f * a.y * b.y, z: f * a.z * b.z }
}

/// M·a.
#[cube]
pub fn times(m: &Mat3, a: &Vec3) -> Vec3 {
    Vec3 { x: dot(&m.r0, a), y: dot(&m.r1, a), z: dot(&m.r2, a) }
}

/// Mᵀ·a.
#[cube]
pub fn transposed_times(m: &Mat3, a: &Vec3) -> Vec3 {
    Vec3 {
        x: m.r0.x * a.x + m.r1.x * a.y + m.r2.x * a.z,
        y: m.r0.y * a.x + m.r1.y * a.y + m.r2.y * a.z,
        z: m.r0.z * a.x + m.r1.z * a.y + m.r2.z * a.z,
    }
}

/// A·B.
#[cube]
pub fn product(a: &Mat3, b: &Mat3) -> Mat3 {
    Mat3 { r0: transposed_times(b, &a.r0), r1: transposed_times(b, &a.r1), r2: transposed_times(b, &a.r2) }
}

/// Aᵀ·B.
#[cube]
pub fn transposed_product(a: &Mat3, b: &Mat3) -> Mat3 {
    let c0 = Vec3 { x: a.r0.x, y: a.r1.x, z: a.r2.x };
    let c1 = Vec3 { x: a.r0.y, y: a.r1.y, z: a.r2.y };
    let c2 = Vec3 { x: a.r0.z, y: a.r1.z, z: a.r2.z };
    Mat3 { r0: transposed_times(b, &c0), r1: transposed_times(b, &c1), r2: transposed_times(b, &c2) }
}

/// Rotation matrix of a unit quaternion.
#[cube]
pub fn rotation_matrix(q: &Quat) -> Mat3 {
    Mat3 {
        r0: Vec3 {
            x: 1.0 - 2.0 * (q.y * q.y + q.z * q.z),
            y: 2.0 * (q.x * q.y - q.w * q.z),
            z: 2.0 * (q.x * q.z + q.w * q.y),
        },
        r1: Vec3 {
            x: 2.0 * (q.x * q.y + q.w * q.z),
            y: 1.0 - 2.0 * (q.x * q.x + q.z * q.z),
            z: 2.0 * (q.y * q.z - q.w * q.x),
        },
        r2: Vec3 {
            x: 2.0 * (q.x * q.z - q.w * q.y),
            y: 2.0 * (q.y * q.z + q.w * q.x),
            z: 1.0 - 2.0 * (q.x * q.x + q.y * q.y),
        },
    }
}

/// The three numbers from index `at` on.
#[cube]
pub fn load3(values: &[f32], at: usize) -> Vec3 {
    Vec3 { x: values[at], y: values[at + 1], z: values[at + 2] }
}

/// Writes three numbers from index `at` on.
#[cube]
pub fn store3(values: &mut [f32], at: usize, v: &Vec3) {
    values[at] = v.x;
    values[at + 1] = v.y;
    values[at + 2] = v.z;
}

/// Adds `v` to `sum`.
#[cube]
pub fn add3(sum: &mut Vec3, v: &Vec3) {
    sum.x += v.x;
    sum.y += v.y;
    sum.z += v.z;
}
