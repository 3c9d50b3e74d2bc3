//! Clothes, hair and colours of a person.

use glam::Vec3;
use rand::Rng;

use crate::figure::Build;
use crate::pattern::{Pattern, Print, hue};

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Cut {
    Bald,
    Short,
    /// To the chin.
    Bob,
    /// Down the back.
    Long,
    Bun,
    Tail,
    Curls,
    /// A cap with a brim over short hair.
    Cap,
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lower {
    /// `length` is a share of the leg, `flare` the additional radius at the hem in metres.
    Trousers { length: f32, flare: f32 },
    /// `length` is a share of the leg, `flare` the additional radius at the hem in hip radii.
    Skirt { length: f32, flare: f32, folds: u32 },
}

/// Clothes. Lengths are shares of the limb, thicknesses metres.
#[derive(Debug, Clone)]
pub struct Outfit {
    pub sleeve: f32,
    pub top_thickness: f32,
    pub sleeve_flare: f32,
    /// Length of the top below the waist, as a share of the distance to the crotch. A coat with a tail has more than 1.
    pub top_length: f32,
    /// Height of the collar around the neck, as a share of the neck; negative for a neckline.
    pub collar: f32,
    /// Buttons down the front.
    pub open_front: bool,
    pub lower: Lower,
    pub lower_thickness: f32,
    /// Height of crumples, metres.
    pub folds: f32,
    /// Share of the leg that boots cover.
    pub boots: f32,
    pub shoe_thickness: f32,
    pub cut: Cut,
    pub skin: Vec3,
    pub hair: Vec3,
    pub lips: Vec3,
    pub eyes: Vec3,
    pub top: Pattern,
    /// Colour of cuffs, collar and hems.
    pub trim: Vec3,
    pub bottom: Pattern,
    pub shoes: Pattern,
    pub front_print: Option<Print>,
    pub back_print: Option<Print>,
    pub belt: Option<Vec3>,
    pub beard: bool,
    pub glasses: bool,
    pub seed: u32,
}

/// A random mixture of two neighbouring tones.
fn tone(random: &mut impl Rng, tones: &[[u8; 3]]) -> Vec3 {
    let at: f32 = random.random_range(0.0..(tones.len() - 1) as f32);
    let color = |i: usize| Vec3::from(tones[i].map(f32::from)) / 255.0;
    let low = at as usize;
    color(low).lerp(color(low + 1), at - low as f32)
}

/// Skin of any descent.
pub fn skin(random: &mut impl Rng) -> Vec3 {
    tone(
        random,
        &[[62, 39, 28], [104, 66, 45], [150, 100, 70], [190, 138, 104], [222, 176, 145], [240, 204, 180]],
    )
}

/// Hair of any colour, dyed hair included.
pub fn hair(random: &mut impl Rng) -> Vec3 {
    if random.random_range(0.0..1.0) < 0.08 {
        return hue(random.random_range(0.0..1.0), 0.6, 0.6);
    }
    tone(random, &[[22, 18, 16], [45, 30, 22], [92, 58, 34], [140, 94, 50], [196, 160, 104], [150, 146, 140]])
}

impl Outfit {
    /// Width of the clothes beyond the hips, in hip widths.
    pub fn breadth(&self) -> f32 {
        let skirt = if let Lower::Skirt { flare, .. } = self.lower { 0.15 + 0.6 * flare } else { 0.0 };
        skirt.max(if self.top_length > 1.0 { 0.22 } else { 0.0 })
    }

    pub fn draw(random: &mut impl Rng, build: &Build) -> Self {
        let mut chance = |p: f32| random.random_range(0.0..1.0) < p;
        let female = chance(0.85 - 0.7 * build.sex);
        let skirt = chance(if female { 0.42 } else { 0.04 });
        let dress = skirt && chance(0.5);
        let coat = !dress && chance(0.2);
        let long_hair = female && chance(0.7);
        let belt = !skirt && chance(0.4);
        let printed = [chance(0.55), chance(0.35)];
        let open_front = coat || chance(0.3);
        let (beard, glasses) = (!female && chance(0.3), chance(0.15));
        let trim_contrast = chance(0.5);

        let mut between = |low: f32, high: f32| random.random_range(low..high);
        let kind = between(0.0, 1.0);
        let sleeve = match kind {
            _ if coat => between(0.9, 0.98),
            // A shorter sleeve would have a ragged edge through the shoulder joint.
            k if k < 0.12 => between(0.14, 0.2),
            k if k < 0.5 => between(0.25, 0.45),
            k if k < 0.6 => between(0.55, 0.75),
            _ => between(0.88, 0.98),
        };
        let loose = between(0.0, 1.0);
        let top_length = match coat {
            true => between(1.3, 3.2),
            false if skirt => between(-0.1, 0.35),
            false => between(0.25, 0.95),
        };
        let lower = if skirt {
            Lower::Skirt {
                length: between(0.28, 0.9),
                flare: between(0.12, 0.7),
                folds: between(5.0, 15.0) as u32,
            }
        } else {
            let length = if between(0.0, 1.0) < 0.25 { between(0.3, 0.6) } else { between(0.8, 0.99) };
            // Mostly narrow.
            let wide = between(0.0, 1.0);
            Lower::Trousers { length, flare: wide * wide * wide * 0.045 }
        };
        let style = between(0.0, 1.0);
        let cut = match style {
            s if long_hair && s < 0.35 => Cut::Long,
            s if long_hair && s < 0.6 => Cut::Bob,
            s if long_hair && s < 0.8 => Cut::Tail,
            _ if long_hair => Cut::Bun,
            s if s < 0.08 => Cut::Bald,
            s if s < 0.2 => Cut::Cap,
            s if s < 0.34 => Cut::Curls,
            _ => Cut::Short,
        };
        let (top_thickness, sleeve_flare) = (0.005 + 0.014 * loose, 0.03 * loose * between(0.0, 1.0));
        let collar = if coat || kind > 0.7 { between(0.2, 0.75) } else { between(-0.35, 0.1) };
        let lower_thickness = between(0.004, 0.014);
        let folds = between(0.0015, 0.005);
        let boots = if between(0.0, 1.0) < 0.2 { between(0.2, 0.5) } else { 0.0 };
        let shoe_thickness = between(0.005, 0.011);

        let top = Pattern::draw(random);
        let bottom = if dress { top.clone() } else { Pattern::draw_quiet(random) };
        let trim = if trim_contrast { Pattern::draw_quiet(random).main() } else { top.main() * 0.75 };
        let [front_print, back_print] = printed.map(|there| there.then(|| Print::draw(random, top.main())));
        let skin = skin(random);
        Self {
            sleeve,
            top_thickness,
            sleeve_flare,
            top_length,
            collar,
            open_front,
            lower,
            lower_thickness,
            folds,
            boots,
            shoe_thickness,
            cut,
            skin,
            hair: hair(random),
            lips: (skin * 0.8).lerp(Vec3::new(0.7, 0.2, 0.25), random.random_range(0.2..0.7)),
            eyes: hue(random.random_range(0.05..0.65), 0.5, 0.35),
            top,
            trim,
            bottom,
            shoes: Pattern::draw_quiet(random),
            front_print: front_print.filter(|_| !open_front),
            back_print,
            belt: belt.then(|| hue(random.random_range(0.0..0.15), 0.4, 0.25)),
            beard,
            glasses,
            seed: random.random(),
        }
    }
}
