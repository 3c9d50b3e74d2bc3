//! Shapes of bodies: MakeHuman's mix of sex, age, descent, muscle, weight, height and proportions, and details.

use glam::Vec3;
use rand::Rng;

use snapsnap_base::FileError;

use super::files::Library;

/// Folders of details, and the largest number of each per person.
const DETAILS: [(&str, usize); 8] = [
    ("nose", 3),
    ("mouth", 3),
    ("chin", 2),
    ("head", 2),
    ("ears", 1),
    ("torso", 2),
    ("hip", 2),
    ("stomach", 1),
];
/// Strongest detail; 1 is the artist's extreme.
const STRONGEST: f32 = 0.55;
/// Words in the names of unused details: unnatural shapes, and shapes that separate parts of the body.
const UNUSUAL: [&str; 6] = ["pointed", "triangle", "pregnant", "trans", "angle-in", "age"];

/// Shares of the macro targets.
#[derive(Debug, Clone)]
pub struct Mix {
    /// 0: female, 1: male.
    pub sex: f32,
    /// Shares of child, young and old.
    ages: [f32; 3],
    /// Shares of African, Asian and Caucasian descent.
    descent: [f32; 3],
    /// 0 to 1, ½ on average.
    muscle: f32,
    pub weight: f32,
    height: f32,
    proportions: f32,
}

impl Mix {
    pub fn draw(random: &mut impl Rng) -> Self {
        let mut between = |low: f32, high: f32| random.random_range(low..high);
        let sex = if between(0.0, 1.0) < 0.5 { between(0.0, 0.2) } else { between(0.8, 1.0) };
        let age = between(0.0, 1.0);
        let ages = if age < 0.1 {
            let child = between(0.2, 0.8);
            [child, 1.0 - child, 0.0]
        } else {
            let old = (age - 0.45).max(0.0) * between(0.4, 1.6);
            [0.0, 1.0 - old.min(1.0), old.min(1.0)]
        };
        // Mostly one descent.
        let shares = [(); 3].map(|()| between(0.0, 1.0)).map(|share| share * share * share + 1e-3);
        let sum: f32 = shares.iter().sum();
        Self {
            sex,
            ages,
            descent: shares.map(|share| share / sum),
            muscle: between(0.2, 0.85),
            // One in five is very thin or very heavy.
            weight: if between(0.0, 1.0) < 0.2 { between(0.0, 1.0) } else { between(0.25, 0.8) },
            height: between(0.25, 0.75),
            proportions: between(0.3, 0.9),
        }
    }

    /// Macro targets and their shares.
    fn macros(&self) -> Vec<(String, f32)> {
        let sexes = [("female", 1.0 - self.sex), ("male", self.sex)];
        let ages = ["child", "young", "old"].into_iter().zip(self.ages);
        let three = |value: f32, names: [&'static str; 3]| {
            let away = 2.0 * (value - 0.5);
            names.into_iter().zip([(-away).max(0.0), 1.0 - away.abs(), away.max(0.0)])
        };
        let muscles = || three(self.muscle, ["minmuscle", "averagemuscle", "maxmuscle"]);
        let weights = || three(self.weight, ["minweight", "averageweight", "maxweight"]);
        let extremes = [
            ("height", "minheight", 1.0 - 2.0 * self.height),
            ("height", "maxheight", 2.0 * self.height - 1.0),
            ("proportions", "uncommonproportions", 1.0 - 2.0 * self.proportions),
            ("proportions", "idealproportions", 2.0 * self.proportions - 1.0),
        ];
        let mut found = Vec::new();
        for (sex, a) in sexes {
            for (age, b) in ages.clone() {
                for (descent, c) in ["african", "asian", "caucasian"].into_iter().zip(self.descent) {
                    found.push((format!("macrodetails/{descent}-{sex}-{age}"), a * b * c));
                }
                for (muscle, c) in muscles() {
                    for (weight, d) in weights() {
                        let share = a * b * c * d;
                        let of = format!("{sex}-{age}-{muscle}-{weight}");
                        found.push((format!("macrodetails/universal-{of}"), share));
                        for (folder, extreme, e) in extremes {
                            found.push((format!("macrodetails/{folder}/{of}-{extreme}"), share * e));
                        }
                    }
                }
            }
        }
        found.retain(|(_, share)| *share > 1e-4);
        found
    }
}

/// Details and their strengths.
fn details(library: &Library, random: &mut impl Rng) -> Result<Vec<(String, f32)>, FileError> {
    let mut found = Vec::new();
    for (folder, most) in DETAILS {
        let is_usual =
            |name: &String| !name.starts_with("r-") && !UNUSUAL.iter().any(|word| name.contains(word));
        let names: Vec<String> = library.targets_in(folder)?.into_iter().filter(is_usual).collect();
        for _ in 0..random.random_range(0..=most) {
            let strength = random.random_range(0.05..STRONGEST);
            if names.is_empty() {
                continue;
            }
            let name = &names[random.random_range(0..names.len())];
            found.push((format!("{folder}/{name}"), strength));
            // The same detail on the right side.
            if let Some(rest) = name.strip_prefix("l-") {
                found.push((format!("{folder}/r-{rest}"), strength));
            }
        }
    }
    Ok(found)
}

/// The vertices of a body, metres, in the pose of the base mesh.
pub fn morph(library: &Library, mix: &Mix, random: &mut impl Rng) -> Result<Vec<Vec3>, FileError> {
    let mut positions = library.positions.clone();
    let mut targets = mix.macros();
    targets.extend(details(library, random)?);
    for (name, share) in targets {
        for (row, moved) in library.target(&name)?.iter() {
            positions[*row as usize] += share * *moved;
        }
    }
    Ok(positions)
}
