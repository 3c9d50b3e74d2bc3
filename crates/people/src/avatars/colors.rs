//! Random colours for a character's clothes and hair.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{Mat3, Vec2, Vec3};
use image::{Rgb, RgbImage};
use rand::Rng;
use rand_chacha::ChaCha8Rng;
use snapsnap_mesh::mesh::{Mesh, bytes};

use super::joints::Region;
use crate::math::smoothstep;

/// The part of the body on a texel.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Shown {
    Nothing,
    /// Head and hair.
    Head,
    Hand,
    /// Trunk, arms, legs and feet: cloth or skin.
    Body,
}

/// A change of a colour.
#[derive(Clone, Copy)]
struct Change {
    /// Rotation of the hue.
    turn: Mat3,
    /// Exponent of the brightness.
    gamma: f32,
}

impl Change {
    /// A random change around `mean`: the hue turns by up to `hue` degrees, and the brightness of `mean` goes the
    /// share `share` of the way to a random brightness.
    fn draw(random: &mut ChaCha8Rng, mean: Vec3, hue: f32, share: f32) -> Self {
        let (sin, cos) = libm::sincosf((hue * random.random_range(-1.0..1.0_f32)).to_radians());
        // A rotation around the axis of greys.
        let (a, b) = ((1.0 - cos) / 3.0, sin / 3.0_f32.sqrt());
        let row = Vec3::new(cos + a, a - b, a + b);
        let turn = Mat3::from_cols(row, Vec3::new(row.z, row.x, row.y), Vec3::new(row.y, row.z, row.x));
        let old = mean.max_element().clamp(0.03, 0.95);
        let new = old + share * (random.random_range(0.06..0.9_f32) - old);
        Self { turn, gamma: (libm::logf(new) / libm::logf(old)).clamp(0.4, 2.5) }
    }

    fn apply(&self, color: Vec3) -> Vec3 {
        let turned = (self.turn * color).clamp(Vec3::ZERO, Vec3::ONE);
        let value = turned.max_element();
        if value <= 0.0 { turned } else { turned * (libm::powf(value, self.gamma) / value) }
    }
}

/// Changes the colours of all textures. `regions`: the part of the body of each position.
pub fn vary(mesh: &mut Mesh, regions: &[Region], random: &mut ChaCha8Rng) {
    let mut done: HashMap<*const RgbImage, Arc<RgbImage>> = HashMap::new();
    for material in 0..mesh.materials.len() {
        let Some(texture) = mesh.materials[material].texture.clone() else { continue };
        let changed = done
            .entry(Arc::as_ptr(&texture))
            .or_insert_with(|| Arc::new(varied(&texture, &shown(mesh, &texture, regions), random)));
        mesh.materials[material].texture = Some(changed.clone());
    }
}

fn varied(texture: &RgbImage, shown: &[Shown], random: &mut ChaCha8Rng) -> RgbImage {
    let has = |what: Shown| shown.contains(&what);
    let mut changed = texture.clone();
    // Without hands and body it is a texture of hair.
    if has(Shown::Head) && !has(Shown::Hand) && !has(Shown::Body) {
        let change = Change::draw(random, mean(texture, shown, Shown::Head), 12.0, 0.5);
        changed.pixels_mut().for_each(|pixel| pixel.0 = bytes(change.apply(floats(pixel))));
        return changed;
    }
    let skin = has(Shown::Hand).then(|| mean(texture, shown, Shown::Hand));
    let cloth = |color: Vec3| skin.map_or(1.0, |skin| unlike(color, skin));
    let colors = texture.pixels().zip(shown).filter(|(_, shown)| **shown == Shown::Body);
    let colors = colors.step_by(STEP).map(|(pixel, _)| floats(pixel));
    let means = main_colors(&colors.filter(|color| cloth(*color) > 0.5).collect::<Vec<_>>());
    let changes: Vec<Change> = means.iter().map(|mean| Change::draw(random, *mean, 180.0, 0.8)).collect();
    for (pixel, _) in changed.pixels_mut().zip(shown).filter(|(_, shown)| **shown == Shown::Body) {
        let color = floats(pixel);
        let cloth = cloth(color);
        if cloth == 0.0 || means.is_empty() {
            continue;
        }
        // Between two main colours, a mixture of their changes.
        let (mut sum, mut weights) = (Vec3::ZERO, 0.0);
        for (mean, change) in means.iter().zip(&changes) {
            let near = 1.0 / (apart(color, *mean) + 1e-4);
            let weight = near * near;
            sum += weight * change.apply(color);
            weights += weight;
        }
        pixel.0 = bytes(color.lerp(sum / weights, cloth));
    }
    changed
}

/// Every `STEP`-th texel is used to find the main colours.
const STEP: usize = 7;

/// Up to three main colours that differ from each other, by k-means.
fn main_colors(colors: &[Vec3]) -> Vec<Vec3> {
    /// Least distance of two main colours.
    const APART: f32 = 0.2;
    let mut sorted = colors.to_vec();
    sorted.sort_unstable_by(|a, b| a.element_sum().total_cmp(&b.element_sum()));
    let mut means: Vec<Vec3> =
        [1, 3, 5].iter().filter_map(|sixth| sorted.get(sorted.len() * sixth / 6)).copied().collect();
    for _ in 0..8 {
        let mut sums = vec![(Vec3::ZERO, 0.0); means.len()];
        for color in colors {
            let distance = |row: &usize| apart(means[*row], *color);
            let nearest = (0..means.len()).min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap_or(0);
            sums[nearest].0 += *color;
            sums[nearest].1 += 1.0;
        }
        for (mean, (sum, count)) in means.iter_mut().zip(sums).filter(|(_, (_, count))| *count > 0.0) {
            *mean = sum / count;
        }
    }
    let mut found: Vec<Vec3> = Vec::new();
    for mean in means {
        if found.iter().all(|other| apart(*other, mean) > APART * APART) {
            found.push(mean);
        }
    }
    found
}

/// Squared distance of two colours. Brightness counts less than hue, since folds change it.
fn apart(a: Vec3, b: Vec3) -> f32 {
    let difference = a - b;
    let grey = Vec3::splat(difference.element_sum() / 3.0);
    (difference - grey).length_squared() + 0.15 * grey.length_squared()
}

fn floats(pixel: &Rgb<u8>) -> Vec3 {
    Vec3::from(pixel.0.map(f32::from)) / 255.0
}

/// The part of the body on each texel, from the faces that cover the texel.
fn shown(mesh: &Mesh, texture: &Arc<RgbImage>, regions: &[Region]) -> Vec<Shown> {
    let (width, height) = (texture.width() as usize, texture.height() as usize);
    let mut shown = vec![Shown::Nothing; width * height];
    // Limits the work for repeated or huge triangles of damaged files.
    let mut budget = 64 * shown.len() as u64;
    for face in &mesh.faces {
        let own = mesh.materials[face.material as usize].texture.as_ref();
        let Some(rows) = face.texcoords.filter(|_| own.is_some_and(|own| Arc::ptr_eq(own, texture))) else {
            continue;
        };
        let what = match regions[face.positions[0] as usize] {
            Region::Head => Shown::Head,
            Region::Hand(_) => Shown::Hand,
            Region::Trunk | Region::Arm | Region::Leg | Region::Foot => Shown::Body,
        };
        let size = Vec2::new(width as f32, height as f32);
        let corners = rows.map(|row| {
            let at = mesh.texcoords[row as usize];
            Vec2::new(at.x, 1.0 - at.y) * size
        });
        fill(corners, &mut budget, |x, y| {
            let (x, y) = (x.rem_euclid(width as i64) as usize, y.rem_euclid(height as i64) as usize);
            shown[y * width + x] = what;
        });
    }
    shown
}

/// Calls `mark` for the texels in a triangle and along its edges, as long as `budget` lasts.
fn fill([a, b, c]: [Vec2; 3], budget: &mut u64, mut mark: impl FnMut(i64, i64)) {
    let (low, high) = (a.min(b).min(c).floor(), a.max(b).max(c).ceil());
    let texels = (high.x - low.x + 1.0) * (high.y - low.y + 1.0);
    // Beyond 1e6, texels are no whole numbers any more.
    if !(texels <= *budget as f32 && low.abs().max(high.abs()).max_element() < 1e6) {
        return;
    }
    *budget -= texels as u64;
    let area = (b - a).perp_dot(c - a);
    for y in low.y as i64..=high.y as i64 {
        for x in low.x as i64..=high.x as i64 {
            let p = Vec2::new(x as f32 + 0.5, y as f32 + 0.5);
            let inside = [(a, b), (b, c), (c, a)].into_iter().all(|(from, to)| {
                let edge = to - from;
                // One texel beyond the edge, for filtered textures.
                edge.perp_dot(p - from) * area.signum() >= -edge.length()
            });
            if inside {
                mark(x, y);
            }
        }
    }
}

/// The mean colour of the texels that show `what`.
fn mean(texture: &RgbImage, shown: &[Shown], what: Shown) -> Vec3 {
    let those = texture.pixels().zip(shown).filter(|(_, shown)| **shown == what);
    let (sum, count) =
        those.fold((Vec3::ZERO, 0.0), |(sum, count), (pixel, _)| (sum + floats(pixel), count + 1.0));
    sum / f32::max(count, 1.0)
}

/// 0 for a colour similar to `skin`, 1 for a different one, by the shares of the channels.
fn unlike(color: Vec3, skin: Vec3) -> f32 {
    let shares = |c: Vec3| c / c.element_sum().max(0.02);
    smoothstep(0.09, 0.16, (shares(color) - shares(skin)).length())
}
