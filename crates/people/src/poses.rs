//! Poses from motion files (BVH): the positions of the joints become the angles of a pose, for any body.

use std::f32::consts::{PI, TAU};
use std::path::Path;

use glam::{Mat3, Vec3};
use rand::Rng;
use snapsnap_base::{FileError, file, folder, quoted};
use snapsnap_mesh::import::Bone;

use crate::figure::{Pose, sign};
use crate::math::{rotate_x, rotate_y, rotate_z};
use crate::skeleton::{Name, hanging, known, need};

/// Largest file, in bytes.
const MAX_BYTES: u64 = 64 << 20;
/// Largest number of joints and of frames that are read.
const MAX_JOINTS: usize = 4096;
const MAX_FRAMES: usize = 65_536;
/// Largest lean of the trunk and bend of a knee of a standing person, degrees.
const LEAN: f32 = 30.0;
const KNEE: f32 = 60.0;
/// Share of people in a pose from a file, if there are files.
const SHARE: f32 = 0.3;
/// Largest random change of an angle, degrees.
const STRAY: f32 = 4.0;

/// Standing poses of a folder of motion files.
#[derive(Debug, Default)]
pub struct Poses {
    poses: Vec<Pose>,
}

impl Poses {
    /// The standing poses in the files `.bvh` of a folder; `None` without one. Other poses, such as seated ones, are
    /// left out.
    ///
    /// # Errors
    /// [`FileError`] for a folder or a file that cannot be read.
    pub fn open(folder: &Path) -> Result<Option<Self>, FileError> {
        let mut poses = Vec::new();
        for path in folder::with_ending(folder, "bvh")? {
            poses.extend(read(&path)?.poses.into_iter().filter(Pose::stands));
        }
        Ok((!poses.is_empty()).then_some(Self { poses }))
    }

    /// A random pose, often one of `poses`.
    pub fn any(poses: Option<&Self>, random: &mut impl Rng) -> Pose {
        match poses {
            Some(poses) if random.random_range(0.0..1.0_f32) < SHARE => poses.draw(random),
            _ => Pose::draw(random),
        }
    }

    /// One of the poses, perhaps mirrored, slightly changed, and with another turn of the head and other fingers.
    fn draw(&self, random: &mut impl Rng) -> Pose {
        let other = Pose::draw(random);
        let row = random.random_range(0..self.poses.len());
        let pose = self.poses[row].clone();
        let mut pose = if random.random() { pose.mirrored() } else { pose };
        (pose.head, pose.fingers) = (other.head, other.fingers);
        let angles = pose.trunk.iter_mut().chain(pose.arms.as_flattened_mut());
        for angle in angles.chain(pose.legs.as_flattened_mut()) {
            *angle += STRAY * random.random_range(-1.0..1.0_f32);
        }
        pose
    }
}

/// The frames of a motion file.
#[derive(Debug, Clone)]
pub struct Motion {
    /// By frame. There may be none.
    pub poses: Vec<Pose>,
    /// Time between two frames, seconds.
    pub step: f32,
}

/// Names of [`Motion::named`].
pub const MOTIONS: [&str; 3] = ["idle", "walk", "wave"];

impl Motion {
    /// A motion of this program, which ends as it begins: to stand at ease, to walk on the spot, or to wave.
    pub fn named(name: &str) -> Option<Self> {
        const RATE: f32 = 30.0;
        let (seconds, pose): (f32, fn(f32) -> Pose) = match name {
            "idle" => (4.0, idle),
            "walk" => (1.1, walk),
            "wave" => (2.4, wave),
            _ => return None,
        };
        let last = (seconds * RATE).round();
        let poses = (0..=last as usize).map(|frame| pose(TAU * frame as f32 / last)).collect();
        Some(Self { poses, step: 1.0 / RATE })
    }
}

/// To breathe and sway. Motions have a phase from 0 to 2π.
fn idle(phase: f32) -> Pose {
    let (breath, sway) = (libm::sinf(2.0 * phase), libm::sinf(phase));
    Pose {
        trunk: [1.0 + 0.6 * breath, 1.5 * sway, 0.8 * sway],
        head: [1.0 - 0.5 * breath, 5.0 * libm::sinf(phase + 0.6), 0.0],
        arms: [[9.0 + 0.8 * breath, 1.0, 8.0, 10.0 + breath], [9.0 + 0.8 * breath, 1.0, 8.0, 10.0 - breath]],
        legs: [[0.0, 3.0, 1.0]; 2],
        ..Pose::default()
    }
}

fn walk(phase: f32) -> Pose {
    let step = libm::sinf(phase);
    let leg = |phase: f32| {
        // The knee bends while the leg swings forwards.
        let swing = libm::cosf(phase + 0.3).max(0.0);
        [24.0 * libm::sinf(phase) + 8.0 * swing, 1.0, 6.0 + 52.0 * swing * swing]
    };
    let arm = |step: f32| [9.0, -22.0 * step, 6.0, 22.0 - 10.0 * step];
    Pose {
        trunk: [3.0, -6.0 * step, 1.5 * libm::cosf(phase)],
        head: [0.0, 4.0 * step, 0.0],
        arms: [arm(step), arm(-step)],
        legs: [leg(phase), leg(phase + PI)],
        ..Pose::default()
    }
}

/// The right arm rises, waves twice and sinks.
fn wave(phase: f32) -> Pose {
    let up = (1.6 * libm::sinf(0.5 * phase)).min(1.0);
    let up = up * up * (3.0 - 2.0 * up);
    let idle = idle(phase);
    let waving = [78.0, 0.0, -85.0, 92.0 + 24.0 * libm::sinf(3.0 * phase)];
    let right = [0, 1, 2, 3].map(|i| idle.arms[1][i] + up * (waving[i] - idle.arms[1][i]));
    Pose { arms: [idle.arms[0], right], ..idle }
}

/// A joint: its parent's index, its offset from the parent, and its channels.
struct Joint {
    name: String,
    parent: Option<usize>,
    offset: Vec3,
    channels: Vec<Channel>,
}

/// Axis of a rotation channel; `None` for a position channel, which is ignored, since bones keep their lengths.
type Channel = Option<usize>;

fn channel(word: &str) -> Option<Channel> {
    match word.to_ascii_lowercase().as_str() {
        "xposition" | "yposition" | "zposition" => Some(None),
        "xrotation" => Some(Some(0)),
        "yrotation" => Some(Some(1)),
        "zrotation" => Some(Some(2)),
        _ => None,
    }
}

/// The motion of a file (BVH) with the joint names of Mixamo or MakeHuman.
///
/// # Errors
/// [`FileError`] naming the file and what is wrong.
pub fn read(path: &Path) -> Result<Motion, FileError> {
    let text = file::read_text(path, MAX_BYTES).map_err(FileError::read(path))?;
    parse(&text).map_err(|problem| FileError::unsuitable(path, problem))
}

fn parse(text: &str) -> Result<Motion, String> {
    let mut words = text.split_ascii_whitespace();
    let expect = |found: Option<&str>, wanted: &str| match found {
        Some(word) if word.eq_ignore_ascii_case(wanted) => Ok(()),
        Some(word) => Err(format!("has `{}` instead of {wanted}", quoted(word))),
        None => Err(format!("ends before {wanted}")),
    };
    expect(words.next(), "HIERARCHY")?;
    let mut joints: Vec<Joint> = Vec::new();
    // Indices of the open joints; `None` for an end site, which has no name.
    let mut open: Vec<Option<usize>> = Vec::new();
    loop {
        let word = words.next().ok_or("ends within its joints")?;
        let own = open.last().copied().flatten();
        match word.to_ascii_uppercase().as_str() {
            "ROOT" | "JOINT" => {
                let name = words.next().ok_or("ends within its joints")?.to_owned();
                expect(words.next(), "{")?;
                if joints.len() == MAX_JOINTS {
                    return Err(format!("has more than {MAX_JOINTS} joints"));
                }
                open.push(Some(joints.len()));
                joints.push(Joint { name, parent: own, offset: Vec3::ZERO, channels: Vec::new() });
            }
            "END" => {
                words.next();
                expect(words.next(), "{")?;
                open.push(None);
            }
            "OFFSET" => {
                let mut next = || number(words.next());
                let offset = Vec3::new(next()?, next()?, next()?);
                if let Some(row) = own {
                    joints[row].offset = offset;
                }
            }
            "CHANNELS" => {
                let row = own.ok_or("has channels outside of a joint")?;
                let count = words.next().and_then(|word| word.parse::<usize>().ok()).filter(|n| *n <= 6);
                let count = count.ok_or("has a joint without a number of channels up to 6")?;
                let channels: Option<Vec<Channel>> = (0..count).map(|_| channel(words.next()?)).collect();
                joints[row].channels = channels.ok_or("has a joint with unknown channels")?;
            }
            "}" => {
                open.pop().ok_or("closes more joints than it opens")?;
            }
            "MOTION" => break,
            _ => return Err(format!("has `{}` among its joints", quoted(word))),
        }
    }
    expect(words.next(), "Frames:")?;
    let frames: usize = words.next().and_then(|word| word.parse().ok()).ok_or("has no number of frames")?;
    if frames > MAX_FRAMES {
        return Err(format!("has more than {MAX_FRAMES} frames"));
    }
    expect(words.next(), "Frame")?;
    expect(words.next(), "Time:")?;
    let step = number(words.next())?;
    let skeleton = Rows::find(joints.iter().map(|joint| &*joint.name))?;
    let mut poses = Vec::new();
    for _ in 0..frames {
        let mut turns: Vec<Mat3> = Vec::with_capacity(joints.len());
        let mut places: Vec<Vec3> = Vec::with_capacity(joints.len());
        for joint in &joints {
            let (mut turn, mut place) = (Mat3::IDENTITY, Vec3::ZERO);
            if let Some(parent) = joint.parent {
                turn = turns[parent];
                place = places[parent] + turn * joint.offset;
            }
            for channel in &joint.channels {
                let value = number(words.next())?;
                if let Some(axis) = channel {
                    turn *= [rotate_x, rotate_y, rotate_z][*axis](value);
                }
            }
            turns.push(turn);
            places.push(place);
        }
        poses.push(skeleton.pose(&places));
    }
    Ok(Motion { poses, step })
}

/// The pose of a character with the joint names of Mixamo or MakeHuman.
///
/// # Errors
/// A sentence that names a missing joint.
pub fn of_bones(bones: &[Bone]) -> Result<Pose, String> {
    let places: Vec<Vec3> = bones.iter().map(|bone| bone.place).collect();
    Ok(Rows::find(bones.iter().map(|bone| &*bone.name))?.pose(&places))
}

fn number(word: Option<&str>) -> Result<f32, String> {
    let word = word.ok_or("ends within its numbers")?;
    let number = word.parse().ok().filter(|value: &f32| value.abs() < 1e6);
    number.ok_or_else(|| format!("has `{}` instead of a number", quoted(word)))
}

/// Indices of the joints that determine a pose. Sides are 0 for the left and 1 for the right.
struct Rows {
    neck: usize,
    /// Shoulder, elbow and wrist.
    arms: [[usize; 3]; 2],
    /// Hip, knee and ankle.
    legs: [[usize; 3]; 2],
}

impl Rows {
    fn find<'a>(names: impl Iterator<Item = &'a str>) -> Result<Self, String> {
        let known: Vec<Option<(Name, usize)>> = names.map(known).collect();
        let limb = |names: [Name; 3], side: usize| -> Result<[usize; 3], String> {
            let [first, second, third] = names.map(|name| need(&known, name, side));
            Ok([first?, second?, third?])
        };
        let arm = [Name::Arm, Name::ForeArm, Name::Hand];
        let leg = [Name::UpLeg, Name::Leg, Name::Foot];
        Ok(Self {
            neck: need(&known, Name::Neck, 0)?,
            arms: [limb(arm, 0)?, limb(arm, 1)?],
            legs: [limb(leg, 0)?, limb(leg, 1)?],
        })
    }

    /// The pose of joints at these positions. Position and heading of the person do not matter.
    fn pose(&self, places: &[Vec3]) -> Pose {
        let at = |row: usize| places[row];
        let [left, right] = self.legs.map(|leg| at(leg[0]));
        let up = at(self.neck) - 0.5 * (left + right);
        // Some files have y up, others z. The hips face along the third axis.
        let vertical = if up.z.abs() > up.y.abs() { Vec3::Z } else { Vec3::Y };
        let world = hanging(-vertical, left - right);
        let inside = |v: Vec3| world.transpose() * v;
        let chest = hanging(-inside(up), inside(at(self.arms[0][0]) - at(self.arms[1][0])));
        // By `Pose::trunk_frame` the pelvis has 0.3 of the lean, and 0.4 of the turn lies between pelvis and chest.
        let pelvis = hanging(-inside(up).lerp(up.length() * Vec3::Y, 0.7), Vec3::X);
        let front = chest.z_axis;
        let turn = libm::atan2f(front.x, front.z).to_degrees();
        let rest = rotate_y(-turn) * chest;
        let lean = libm::asinf((-rest.z_axis.y).clamp(-1.0, 1.0)).to_degrees();
        let straight = rotate_x(-lean) * rest;
        let aside = libm::atan2f(straight.x_axis.y, straight.x_axis.x).to_degrees();
        let mut pose = Pose { trunk: [lean, turn / 0.4, aside], ..Pose::default() };
        for side in [0, 1] {
            let [shoulder, elbow, wrist] = self.arms[side].map(|row| inside(at(row)));
            let [apart, forwards] = raised(chest.transpose() * (elbow - shoulder), side);
            let upper = chest * rotate_x(-forwards) * rotate_z(sign(side) * apart);
            let fore = upper.transpose() * (wrist - elbow).normalize_or(Vec3::NEG_Y);
            let bend = libm::acosf((-fore.y).clamp(-1.0, 1.0)).to_degrees();
            // A straight arm shows no twist.
            let twist =
                if bend > 8.0 { -sign(side) * libm::atan2f(fore.x, fore.z).to_degrees() } else { 0.0 };
            pose.arms[side] = [apart, forwards, twist, bend];
            let [hip, knee, ankle] = self.legs[side].map(|row| inside(at(row)));
            let [apart, forwards] = raised(pelvis.transpose() * (knee - hip), side);
            let (thigh, calf) =
                ((knee - hip).normalize_or(Vec3::NEG_Y), (ankle - knee).normalize_or(Vec3::NEG_Y));
            pose.legs[side] = [forwards, apart, thigh.angle_between(calf).to_degrees()];
        }
        pose
    }
}

/// Degrees by which a hanging limb is raised aside, and then forwards, to point along `way`.
fn raised(way: Vec3, side: usize) -> [f32; 2] {
    let way = way.normalize_or(Vec3::NEG_Y);
    let aside = sign(side) * libm::asinf(way.x.clamp(-1.0, 1.0)).to_degrees();
    [aside, libm::atan2f(way.z, -way.y).to_degrees()]
}

impl Pose {
    /// Whether this is a pose of a person who stands.
    fn stands(&self) -> bool {
        let [lean, _, aside] = self.trunk;
        let is_straight = |leg: &[f32; 3]| leg[2] < KNEE && leg[0].abs() < KNEE && leg[1].abs() < LEAN;
        lean.abs() < LEAN && aside.abs() < LEAN && self.legs.iter().all(is_straight)
    }

    /// The pose with left and right exchanged.
    fn mirrored(self) -> Self {
        let ([lean, turn, aside], [nod, look, tilt]) = (self.trunk, self.head);
        let ([left, right], [a, b], [c, d]) = (self.arms, self.legs, self.toes);
        Self {
            trunk: [lean, -turn, -aside],
            head: [nod, -look, -tilt],
            arms: [right, left],
            legs: [b, a],
            toes: [d, c],
            ..self
        }
    }
}

#[cfg(test)]
mod tests {
    use snapsnap_base::random::stream;

    use super::*;
    use crate::figure::{Build, Figure};

    /// A motion file of one frame without rotations, whose offsets are a figure's bones, turned, with z upwards.
    fn bvh(figure: &Figure) -> String {
        let turn = rotate_z(70.0);
        let offset = |from: Vec3, to: Vec3| {
            let way = to - from;
            turn * Vec3::new(way.x, -way.z, way.y) * 10.0
        };
        let start = |name: &str, way: Vec3| {
            let Vec3 { x, y, z } = way;
            format!("JOINT {name}\n{{\nOFFSET {x} {y} {z}\nCHANNELS 3 Zrotation Xrotation Yrotation\n")
        };
        let chain = |side: &str, names: [&str; 3], [a, b, c, d]: [Vec3; 4]| {
            let ways = [offset(a, b), offset(b, c), offset(c, d)];
            let joints = names.into_iter().zip(ways).map(|(name, way)| start(&format!("{side}{name}"), way));
            let ends = format!("End Site\n{{\nOFFSET 0 0 0\n}}\n{}", "}\n".repeat(3));
            joints.collect::<String>() + &ends
        };
        let hips = figure.pelvis.start;
        let mut text = start("Hips", Vec3::ZERO).replace("JOINT", "ROOT");
        text += &start("Neck", offset(hips, figure.chest.end));
        text += "}\n";
        for (side, word) in ["Left", "Right"].into_iter().enumerate() {
            let (arm, fore) = (figure.upper_arms[side], figure.forearms[side]);
            text += &chain(word, ["Arm", "ForeArm", "Hand"], [hips, arm.start, fore.start, fore.end]);
            let (thigh, calf) = (figure.thighs[side], figure.calves[side]);
            text += &chain(word, ["UpLeg", "Leg", "Foot"], [hips, thigh.start, calf.start, calf.end]);
        }
        let zeros = "0 ".repeat(3 * 14);
        format!("HIERARCHY\n{text}}}\nMOTION\nFrames: 1\nFrame Time: 0.04\n{zeros}\n")
    }

    /// Figures of random poses, written as motion files, come out in the same pose.
    #[test]
    fn joints_give_the_pose_that_they_were_made_of() {
        let mut random = stream("test/poses");
        let build = Build::draw(&mut random);
        for index in 0..40 {
            let mut pose = Pose::draw(&mut random);
            // Beyond 80°, an arm has two descriptions.
            pose.arms.iter_mut().for_each(|arm| arm[0] = arm[0].min(80.0));
            // Files tell the trunk's ends alone.
            pose.spine = [0.0; 3];
            let figure = Figure::new(build.clone(), &pose);
            let found = parse(&bvh(&figure)).expect("reads").poses.remove(0);
            let again = Figure::new(build.clone(), &found);
            let turned = |a: Vec3, b: Vec3| a.angle_between(b).to_degrees();
            let ways = |figure: &Figure| {
                let chest = figure.chest.frame.transpose();
                let pelvis = figure.pelvis.frame.transpose();
                let way = |bone: &crate::figure::Bone| (bone.end - bone.start).normalize();
                let arms = figure.upper_arms.iter().chain(&figure.forearms).map(|bone| chest * way(bone));
                let legs = figure.thighs.iter().chain(&figure.calves).map(|bone| pelvis * way(bone));
                arms.chain(legs).collect::<Vec<_>>()
            };
            for (limb, (a, b)) in ways(&figure).into_iter().zip(ways(&again)).enumerate() {
                // Hips and shoulders follow the positions of their joints, not the trunk's axes.
                assert!(turned(a, b) < 9.0, "pose {index}, limb {limb}: {} {pose:?} {found:?}", turned(a, b));
            }
        }
    }

    #[test]
    fn damaged_motion_files_are_refused() {
        let figure = Figure::new(Build::draw(&mut stream("a")), &Pose::default());
        let sound = bvh(&figure);
        assert_eq!(parse(&sound).expect("reads").poses.len(), 1);
        for (from, to, expected) in [
            ("HIERARCHY", "HIER", "instead of HIERARCHY"),
            ("Frames: 1", "Frames: 2", "ends within its numbers"),
            ("Frames: 1", "Frames: many", "no number of frames"),
            ("CHANNELS 3", "CHANNELS 9", "number of channels"),
            ("Zrotation", "Wrotation", "unknown channels"),
            ("LeftForeArm", "Left", "no joint `LeftForeArm`"),
            ("MOTION", "}\nMOTION", "closes more joints than it opens"),
            ("OFFSET 0 0 0", "OFFSET 0 0 inf", "`inf` instead of a number"),
            ("End Site", "Begin Site", "`Begin` among its joints"),
        ] {
            let error = parse(&sound.replacen(from, to, 1)).expect_err(expected);
            assert!(error.contains(expected), "{expected}: {error}");
        }
        for end in (0..sound.len() - 90).step_by(37) {
            assert!(parse(&sound[..end]).is_err(), "{end}");
        }
    }

    #[test]
    fn motions_end_as_they_begin_and_never_leap() {
        for name in MOTIONS {
            let poses = Motion::named(name).expect("a motion of this name").poses;
            let angles = |pose: &Pose| {
                [&pose.trunk[..], &pose.head, pose.arms.as_flattened(), pose.legs.as_flattened()].concat()
            };
            let apart = |a: &Pose, b: &Pose| {
                angles(a).iter().zip(angles(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
            };
            assert!(apart(&poses[0], &poses[poses.len() - 1]) < 1e-3, "{name}");
            // Degrees in a thirtieth of a second.
            let fastest = poses.windows(2).map(|pair| apart(&pair[0], &pair[1])).fold(0.0, f32::max);
            assert!(fastest < 15.0, "{name}: {fastest}");
        }
    }
}
