//! Colours of skin and clothes on the charts of a body's parts.

use std::f32::consts::{FRAC_PI_2, PI};

use glam::{Vec2, Vec3};

use super::outfit::{Cut, Lower, Outfit};
use super::part::{Kind, Marks, Part};
use crate::figure::Figure;
use crate::math::{noise2, smoothstep};

/// Positions of the features of a face: angles around the head, and heights above the chin as shares of the head.
#[derive(Debug, Clone)]
pub struct Face {
    pub eye: (f32, f32),
    pub brow: f32,
    pub mouth: f32,
    /// Half width and half height of the lips.
    pub lips: [f32; 2],
    /// Paints eyes and nostrils, which the surface of the head does not have.
    pub painted: bool,
}

/// The face of people of simple shapes.
pub const FACE: Face =
    Face { eye: (0.41, 0.455), brow: 0.545, mouth: 0.19, lips: [0.3, 0.034], painted: true };

/// A person's colours.
pub struct Painter<'a> {
    outfit: &'a Outfit,
    marks: Marks,
    /// Centre of prints, metres along the trunk.
    chest: f32,
    face: &'a Face,
    /// Whether trunk, arms and legs have the colour of skin, and whether feet have it.
    bare: [bool; 2],
}

impl<'a> Painter<'a> {
    /// `bare`: whether trunk, arms and legs, and whether feet, get the colour of skin instead of cloth.
    pub fn new(figure: &Figure, outfit: &'a Outfit, face: &'a Face, bare: [bool; 2]) -> Self {
        let chest = 1.7 * figure.pelvis.length() + 0.55 * figure.chest.length();
        Self { outfit, marks: Marks::of(figure, outfit), chest, face, bare }
    }

    /// Colour at a point of a part's chart: angle around the axis (0 in front, positive towards +x), metres along it.
    pub fn color(&self, part: &Part, angle: f32, along: f32) -> Vec3 {
        let cloth = Vec2::new(angle * part.radius, along);
        let [body, feet] = self.bare;
        match part.kind {
            Kind::Trunk | Kind::Arm | Kind::Leg if body => self.skin(cloth, 1),
            Kind::Foot if feet => self.skin(cloth, 3),
            Kind::Trunk => self.trunk(angle, along, cloth),
            Kind::Arm => self.arm(part, along, cloth),
            Kind::Hand => self.skin(cloth, 3),
            Kind::Leg => self.leg(part, angle, along, cloth),
            Kind::Foot => self.foot(part, angle, along, cloth),
            Kind::Head => self.head(angle, along / part.length, cloth),
            Kind::Hair => self.hair(part, angle, along, cloth),
            Kind::Skirt => self.skirt(part, angle, along, cloth),
        }
    }

    fn skin(&self, at: Vec2, seed: u32) -> Vec3 {
        let patch = noise2(at * 40.0, self.outfit.seed ^ seed) - 0.5;
        let pore = noise2(at * 500.0, self.outfit.seed ^ seed ^ 9) - 0.5;
        self.outfit.skin * (1.0 + 0.1 * patch + 0.06 * pore)
    }

    fn trunk(&self, angle: f32, along: f32, cloth: Vec2) -> Vec3 {
        let Outfit { top, bottom, trim, .. } = self.outfit;
        let Marks { hem, waistband, .. } = self.marks;
        let collar = self.marks.collar(angle);
        if along > collar {
            return self.skin(cloth, 1);
        }
        if along < hem {
            if along > waistband {
                return self.skin(cloth, 1);
            }
            if let Some(belt) = self.outfit.belt.filter(|_| along > waistband - 0.032) {
                let buckle = cloth.x.abs() < 0.022 && (along - waistband + 0.016).abs() < 0.013;
                return if buckle { Vec3::new(0.75, 0.72, 0.6) } else { belt };
            }
            return bottom.color(cloth);
        }
        if along > collar - 0.012 || along < hem + 0.01 {
            return *trim;
        }
        let mut color = top.color(cloth);
        if self.outfit.open_front {
            let button = Vec2::new(cloth.x - 0.012, (along / 0.075).fract() * 0.075 - 0.0375);
            if button.length() < 0.006 {
                return Vec3::splat(0.9) - *trim * 0.6;
            }
            if cloth.x.abs() < 0.0025 {
                return color * 0.45;
            }
            // A breast pocket with its seam.
            let pocket = (cloth - Vec2::new(0.085, self.chest + 0.03)).abs() / Vec2::new(0.045, 0.05);
            let edge = pocket.max_element();
            if edge < 1.0 && edge > 0.93 {
                color *= 0.6;
            }
        }
        if let Some(print) = &self.outfit.front_print
            && angle.abs() < FRAC_PI_2
        {
            color = print.over(color, Vec2::new(cloth.x, along - self.chest));
        }
        if let Some(print) = &self.outfit.back_print
            && angle.abs() > FRAC_PI_2
        {
            // From behind, the angle decreases to the right.
            let around = if angle > 0.0 { PI - angle } else { -PI - angle };
            color = print.over(color, Vec2::new(around * cloth.x / angle, along - self.chest - 0.02));
        }
        // Seams at the sides.
        if (angle.abs() - FRAC_PI_2).abs() * cloth.x.abs() / angle.abs().max(0.1) < 0.0015 {
            color * 0.7
        } else {
            color
        }
    }

    fn arm(&self, part: &Part, along: f32, cloth: Vec2) -> Vec3 {
        let end = self.outfit.sleeve * part.length;
        if along > end {
            return self.skin(cloth, 2);
        }
        if along > end - 0.022 {
            return self.outfit.trim;
        }
        // The rows of the cloth run across the sleeve.
        self.outfit.top.color(Vec2::new(cloth.x, -along))
    }

    fn leg(&self, part: &Part, angle: f32, along: f32, cloth: Vec2) -> Vec3 {
        let Outfit { boots, shoes, bottom, lower, trim, .. } = self.outfit;
        if *boots > 0.0 && along > (1.0 - boots) * part.length {
            return shoes.color(cloth);
        }
        match lower {
            Lower::Trousers { length, .. } if along < length * part.length => {
                let hem = along > length * part.length - 0.008;
                let seam = (angle.abs() - FRAC_PI_2).abs() * part.radius < 0.0018;
                let color = bottom.color(Vec2::new(cloth.x, -along));
                if hem || seam { color * 0.65 } else { color }
            }
            // Socks.
            _ if along > part.length - 0.05 => trim.lerp(Vec3::ONE, 0.5),
            _ => self.skin(cloth, 4),
        }
    }

    fn foot(&self, part: &Part, angle: f32, along: f32, cloth: Vec2) -> Vec3 {
        if angle.abs() > 1.9 {
            return Vec3::splat(if self.outfit.trim.element_sum() > 1.5 { 0.92 } else { 0.12 });
        }
        let laced = along > 0.42 * part.length && along < 0.85 * part.length && angle.abs() < 0.5;
        if laced && (along / 0.012).fract() < 0.35 {
            return Vec3::ONE - self.outfit.shoes.main() * 0.8;
        }
        let toe = smoothstep(0.88, 0.93, along / part.length);
        self.outfit.shoes.color(cloth).lerp(self.outfit.shoes.main() * 0.6, toe)
    }

    /// `up`: height above the chin, as a share of the head.
    fn head(&self, angle: f32, up: f32, cloth: Vec2) -> Vec3 {
        let Outfit { hair, lips, eyes, cut, .. } = self.outfit;
        let mut color = self.skin(cloth, 5);
        let aside = angle.abs();
        let face = self.face;
        let (eye_angle, eye_up) = face.eye;
        // Red cheeks.
        let cheek = Vec2::new((aside - 0.75) / 0.4, (up - 0.36) / 0.12);
        let blush = (1.0 - cheek.length_squared()).max(0.0);
        color = color.lerp(Vec3::new(0.8, 0.35, 0.3) * self.outfit.skin.x.max(0.3), 0.18 * blush);
        if self.outfit.beard {
            // Higher towards the ears, up to the hair.
            let above = up - face.mouth;
            let edge = 0.08 + 0.4 * smoothstep(1.0, 1.5, aside);
            let chin = smoothstep(edge, edge - 0.06, above) * smoothstep(1.75, 1.6, aside);
            // Over the lip, lower towards its corners.
            let lip = Vec2::new(aside / 0.4, (above - 0.07 + 0.2 * aside * aside) / 0.035).length();
            let lip = smoothstep(1.0, 0.7, lip);
            let strand = 0.7 + 0.4 * noise2(Vec2::new(angle * 60.0, up * 30.0), 11);
            color = color.lerp(*hair * strand, chin.max(lip) * 0.9);
        }
        let mouth = Vec2::new(angle / face.lips[0], (up - face.mouth) / face.lips[1]);
        if mouth.length() < 1.0 {
            let parted = (up - face.mouth).abs() < 0.004;
            color = if parted { *lips * 0.45 } else { *lips };
        }
        let nostril = Vec2::new((aside - 0.075) / 0.03, (up - 0.3) / 0.013);
        if face.painted && nostril.length() < 1.0 {
            color *= 0.5;
        }
        let brow =
            Vec2::new((aside - eye_angle) / 0.22, (up - face.brow - 0.02 * (aside - eye_angle)) / 0.017);
        if brow.length() < 1.0 {
            color = *hair * 0.7;
        }
        let from_eye = Vec2::new(aside - eye_angle, up - eye_up);
        let eye = (from_eye / Vec2::new(0.135, 0.036)).length();
        if face.painted && eye < 1.15 {
            color *= 0.45;
        }
        if face.painted && eye < 1.0 {
            let iris = ((from_eye - Vec2::new(0.0, 0.002)) / Vec2::new(0.056, 0.034)).length();
            color = match iris {
                r if r < 0.42 => Vec3::splat(0.03),
                r if r < 1.0 => *eyes,
                _ => Vec3::splat(0.9),
            };
        }
        if self.outfit.glasses {
            let rim = Vec2::new((aside - 0.41) / 0.24, (up - 0.455) / 0.085).length();
            let bridge = aside < 0.2 && (up - 0.475).abs() < 0.008;
            let temple = aside > 0.62 && aside < 1.6 && (up - 0.47).abs() < 0.008;
            if (rim - 1.0).abs() < 0.12 || bridge || temple {
                color = Vec3::splat(0.06);
            }
        }
        // Cropped hair below the edge of the hair's surface.
        if *cut != Cut::Bald && aside > 1.9 && up > 0.22 {
            color = color.lerp(*hair, 0.85);
        }
        color
    }

    fn hair(&self, part: &Part, angle: f32, along: f32, cloth: Vec2) -> Vec3 {
        // The rim of a cap, with hair below it.
        let rim = 0.6 * part.length;
        if self.outfit.cut == Cut::Cap && along > rim {
            let seam = (angle * 3.0 / PI).fract().abs() < 0.02;
            let color = self.outfit.shoes.color(cloth);
            return if seam || along < rim + 0.012 { color * 0.7 } else { color };
        }
        let strand = noise2(Vec2::new(angle * 38.0, along * 12.0), self.outfit.seed ^ 21);
        let fine = noise2(Vec2::new(angle * 160.0, along * 40.0), self.outfit.seed ^ 22);
        self.outfit.hair * (0.62 + 0.5 * strand + 0.25 * fine)
    }

    fn skirt(&self, part: &Part, angle: f32, along: f32, cloth: Vec2) -> Vec3 {
        let is_coat = part.side == 1;
        let pattern = if is_coat { &self.outfit.top } else { &self.outfit.bottom };
        let color = pattern.color(Vec2::new(cloth.x, -along));
        if along > part.length - 0.018 {
            return if is_coat { color * 0.8 } else { self.outfit.trim };
        }
        if is_coat && angle.abs() * part.radius < 0.003 { color * 0.4 } else { color }
    }
}
