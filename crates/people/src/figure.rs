//! Proportions and pose, and the bones that follow from them.

use glam::{Mat3, Vec3};
use rand::Rng;

use crate::math::{rotate_x, rotate_y, rotate_z};

/// Proportions of a body.
#[derive(Debug, Clone, Default)]
pub struct Build {
    /// Stature in metres.
    pub stature: f32,
    /// 0: proportions of most women, 1: of most men.
    pub sex: f32,
    /// Girth of limbs and trunk, 1 on average.
    pub girth: f32,
    /// Size of the belly, 0 to 1.
    pub belly: f32,
    /// Lengths of legs and arms and breadth of the shoulders, 1 on average.
    pub legs: f32,
    pub arms: f32,
    pub shoulders: f32,
    /// Size of the head, 1 on average.
    pub head: f32,
}

impl Build {
    pub fn draw(random: &mut impl Rng) -> Self {
        let sex: f32 = random.random_range(0.0..1.0);
        let stature = random.random_range(1.52..1.78) + 0.14 * sex;
        // One in five is heavy.
        let heavy: f32 = random.random_range(0.0..1.0);
        let girth = random.random_range(0.84..1.2) + 0.9 * (heavy - 0.8).max(0.0);
        Self {
            stature,
            sex,
            girth,
            belly: if girth > 1.0 { random.random_range(0.0..1.0) } else { 0.0 },
            legs: random.random_range(0.95..1.05),
            arms: random.random_range(0.95..1.05),
            shoulders: random.random_range(0.94..1.06),
            head: random.random_range(1.02..1.14),
        }
    }
}

/// Angles in degrees. Arrays hold the left side (towards +x) and the right.
#[derive(Debug, Clone, Default)]
pub struct Pose {
    /// Trunk: lean forwards, turn, lean aside.
    pub trunk: [f32; 3],
    /// Forward bends of pelvis, shoulders and neck beside a straight back: lordosis, kyphosis, head forward.
    pub spine: [f32; 3],
    /// Head: nod, turn, tilt.
    pub head: [f32; 3],
    /// Arms: raised aside, raised forwards, turned inwards; bend of the elbow.
    pub arms: [[f32; 4]; 2],
    /// Legs: raised forwards, raised aside; bend of the knee.
    pub legs: [[f32; 3]; 2],
    /// Toes: turned outwards, beside 9°.
    pub toes: [f32; 2],
    /// Curl of the fingers.
    pub fingers: f32,
}

/// Share of people who walk.
const WALKING: f32 = 0.17;
/// Share of people with both knees bent.
const BENT: f32 = 0.15;
/// Kinds of poses of an arm: the share of arms up to each kind, and the ranges of [`Pose::arms`].
const ARMS: [(f32, [(f32, f32); 4]); 12] = [
    // Close to the body.
    (0.18, [(4.0, 12.0), (-8.0, 10.0), (-5.0, 25.0), (3.0, 22.0)]),
    // A little away.
    (0.34, [(10.0, 25.0), (-8.0, 12.0), (-5.0, 25.0), (3.0, 30.0)]),
    // Farther away.
    (0.44, [(25.0, 55.0), (-8.0, 8.0), (-10.0, 20.0), (2.0, 20.0)]),
    // About level.
    (0.48, [(70.0, 95.0), (-8.0, 8.0), (-10.0, 20.0), (0.0, 12.0)]),
    // Raised.
    (0.52, [(115.0, 165.0), (-10.0, 10.0), (-20.0, 20.0), (0.0, 60.0)]),
    // On the hip.
    (0.62, [(42.0, 52.0), (-22.0, -12.0), (78.0, 95.0), (88.0, 102.0)]),
    // In the pocket.
    (0.7, [(14.0, 24.0), (-26.0, -12.0), (15.0, 40.0), (30.0, 52.0)]),
    // The hand before the hips.
    (0.76, [(8.0, 16.0), (5.0, 20.0), (45.0, 65.0), (35.0, 60.0)]),
    // The hand raised before the body, as with a phone.
    (0.83, [(5.0, 20.0), (0.0, 30.0), (5.0, 45.0), (80.0, 130.0)]),
    // Across the chest.
    (0.87, [(8.0, 18.0), (20.0, 42.0), (65.0, 85.0), (92.0, 112.0)]),
    // The hand behind the hips.
    (0.91, [(10.0, 20.0), (-38.0, -24.0), (70.0, 95.0), (25.0, 55.0)]),
    // Anywhere.
    (1.0, [(12.0, 110.0), (-15.0, 60.0), (-10.0, 60.0), (5.0, 95.0)]),
];

impl Pose {
    /// Somebody who stands straight, with the arms raised aside by these degrees: 90 for a T, 45 for an A.
    pub fn standing(arms: f32) -> Self {
        Self { arms: [[arms, 0.0, 0.0, 0.0]; 2], legs: [[0.0, 3.0, 0.0]; 2], ..Self::default() }
    }

    /// A random pose of somebody who stands or walks.
    pub fn draw(random: &mut impl Rng) -> Self {
        let mut between = |low: f32, high: f32| random.random_range(low..high);
        // Hips before (negative) or behind the ankles, up to 10 cm. The trunk leans to the other side.
        let sway = between(-6.5, 4.0);
        let (lordosis, kyphosis) = (between(-8.0, 12.0), between(-8.0, 14.0));
        let mut pose = Self {
            trunk: [between(-4.0, 8.0) + between(0.0, 1.0) * sway, between(-10.0, 10.0), between(-4.0, 4.0)],
            spine: [lordosis, kyphosis, between(-6.0, 20.0)],
            head: [between(-8.0, 14.0), between(-30.0, 30.0), between(-8.0, 8.0)],
            fingers: between(5.0, 35.0),
            ..Self::default()
        };
        let (stance, out) = (between(0.0, 12.0), between(-10.0, 16.0));
        let bent = if between(0.0, 1.0) < BENT { between(6.0, 24.0) } else { 0.0 };
        for (leg, toes) in pose.legs.iter_mut().zip(&mut pose.toes) {
            let knee = bent + between(0.0, 8.0);
            *leg = [sway + 0.5 * knee + between(-3.0, 3.0), stance + between(-1.0, 1.0), knee];
            *toes = out + between(-6.0, 6.0);
        }
        // The weight on one leg, the other a little forwards and bent.
        if between(0.0, 1.0) < 0.3 {
            let free = usize::from(between(0.0, 1.0) < 0.5);
            pose.legs[free] = [between(6.0, 20.0), between(2.0, 14.0), between(8.0, 30.0)];
            pose.legs[1 - free] = [sway + between(-1.0, 2.0), between(-2.0, 3.0), between(0.0, 3.0)];
            pose.trunk[2] = sign(free) * between(0.0, 6.0);
        }
        let swing = if between(0.0, 1.0) < 0.5 { 1.0 } else { -1.0 };
        let kind = between(0.0, 1.0);
        if kind < WALKING {
            for side in 0..2 {
                let across = if side == 0 { swing } else { -swing };
                let stride = between(14.0, 28.0);
                pose.legs[side] = if across > 0.0 {
                    [stride, between(1.0, 4.0), between(2.0, 12.0)]
                } else {
                    [-stride * 0.7, between(1.0, 4.0), between(10.0, 28.0)]
                };
                let raise = -across * between(15.0, 32.0);
                pose.arms[side] = [between(9.0, 14.0), raise, between(0.0, 15.0), between(10.0, 40.0)];
            }
            return pose.hung();
        }
        // Both arms have the same kind of pose, or each has its own.
        let kind = between(0.0, 1.0);
        let alike = between(0.0, 1.0) < 0.6;
        for arm in &mut pose.arms {
            let kind = if alike { kind } else { between(0.0, 1.0) };
            let (_, ranges) = ARMS.into_iter().find(|(share, _)| kind < *share).expect("kinds are below 1");
            *arm = ranges.map(|(low, high)| between(low, high));
        }
        pose.hung()
    }

    /// The pose with limbs that hang down from a bent spine as they do from a straight one.
    fn hung(mut self) -> Self {
        let [lordosis, kyphosis, _] = self.spine;
        self.legs.iter_mut().for_each(|leg| leg[0] += lordosis);
        self.arms.iter_mut().for_each(|arm| arm[1] += 0.7 * kyphosis);
        self
    }

    /// Axes of the trunk, from the pelvis (0) to the shoulders (1).
    pub fn trunk_frame(&self, share: f32) -> Mat3 {
        /// Share of the waist, which bends backwards where pelvis and shoulders bend forwards.
        const WAIST: f32 = 0.45;
        let ([lean, turn, aside], [lordosis, kyphosis, _]) = (self.trunk, self.spine);
        let waist = -0.5 * (lordosis + kyphosis);
        let bend = if share < WAIST {
            lordosis + (waist - lordosis) * share / WAIST
        } else {
            waist + (kyphosis - waist) * (share - WAIST) / (1.0 - WAIST)
        };
        let lean = (0.3 + 0.7 * share) * lean + bend;
        rotate_y((0.3 + 0.4 * share) * turn) * rotate_x(lean) * rotate_z(share * aside)
    }

    /// Axes of neck and head, from the shoulders (0) to the skull (1).
    pub fn head_frame(&self, share: f32) -> Mat3 {
        let [nod, look, tilt] = self.head;
        let [_, kyphosis, forward] = self.spine;
        let upright = nod - 0.5 * self.trunk[0] - kyphosis;
        // The neck leans forwards, the skull does not.
        let bend = share * upright + 4.0 * share * (1.0 - share) * forward;
        self.trunk_frame(1.0) * rotate_y(share * look) * rotate_x(bend) * rotate_z(share * tilt)
    }

    /// Degrees that an arm is raised aside beyond 35, where the collarbone begins to move.
    pub fn lift(&self, side: usize) -> f32 {
        (self.arms[side][0] - 35.0).max(0.0)
    }

    /// Moves hanging arms away from clothes. `share` is the width of the clothes beyond the hips, in hip widths.
    pub fn spread_arms(&mut self, share: f32) {
        for arm in &mut self.arms {
            arm[0] = arm[0].max((6.0 + 36.0 * share).min(30.0));
        }
    }

    /// Moves arms out of the trunk and returns the result of `posed`. In small steps a bent arm is stretched and a
    /// straight arm is raised. `sunk` returns whether the left and the right hand lie in the trunk.
    pub fn free_hands<T>(&mut self, posed: impl Fn(&Self) -> T, sunk: impl Fn(&T) -> [bool; 2]) -> T {
        /// Largest number of steps.
        const STEPS: usize = 24;
        let mut body = posed(self);
        for _ in 0..STEPS {
            let sunk = sunk(&body);
            if sunk == [false; 2] {
                break;
            }
            for ([aside, _, _, bend], _) in self.arms.iter_mut().zip(sunk).filter(|(_, sunk)| *sunk) {
                if *bend > 45.0 { *bend -= 4.0 } else { *aside += 4.0 }
            }
            body = posed(self);
        }
        body
    }
}

/// A straight piece of the body. The columns of `frame` point to the right, up and to the front in an upright pose.
#[derive(Debug, Clone, Copy)]
pub struct Bone {
    pub start: Vec3,
    pub end: Vec3,
    pub frame: Mat3,
}

impl Bone {
    /// A bone that stands on `start`, or hangs from it if its length is negative.
    fn upright(start: Vec3, frame: Mat3, length: f32) -> Self {
        Self { start, end: start + frame.y_axis * length, frame }
    }

    /// A bone with the axes of the world.
    pub fn straight(start: Vec3, end: Vec3) -> Self {
        Self { start, end, frame: Mat3::IDENTITY }
    }

    pub fn length(&self) -> f32 {
        (self.end - self.start).length()
    }

    /// The point at this share of the bone's length.
    pub fn point(&self, along: f32) -> Vec3 {
        self.start.lerp(self.end, along)
    }

    /// [`point`](Self::point), moved by `offset` along the bone's axes.
    pub fn at(&self, along: f32, offset: Vec3) -> Vec3 {
        self.point(along) + self.frame * offset
    }
}

/// A posed body. Arrays hold the left side (towards +x) and the right. The pelvis is at the origin.
#[derive(Debug, Clone)]
pub struct Figure {
    pub build: Build,
    pub fingers: f32,
    /// From the middle of the hips to the waist.
    pub pelvis: Bone,
    /// From the waist to the base of the neck.
    pub chest: Bone,
    pub neck: Bone,
    /// From the top of the neck to the crown.
    pub head: Bone,
    pub upper_arms: [Bone; 2],
    pub forearms: [Bone; 2],
    pub hands: [Bone; 2],
    pub thighs: [Bone; 2],
    pub calves: [Bone; 2],
    /// From the ankle down to the height of the ball; the front axis points to the toes.
    pub feet: [Bone; 2],
}

/// +1 for the left side, −1 for the right.
pub fn sign(side: usize) -> f32 {
    if side == 0 { 1.0 } else { -1.0 }
}

impl Figure {
    /// Lengths are shares of the stature after Drillis and Contini (1966).
    pub fn new(build: Build, pose: &Pose) -> Self {
        let h = build.stature;
        let turn = pose.trunk[1];
        let (pelvis_frame, chest_frame) = (pose.trunk_frame(0.0), pose.trunk_frame(1.0));
        let pelvis = Bone::upright(Vec3::ZERO, pelvis_frame, 0.095 * h);
        let chest = Bone::upright(pelvis.end, chest_frame, 0.215 * h);
        let neck_frame = chest_frame * rotate_x(0.4 * pose.head[0] + pose.spine[2] + 8.0);
        let neck = Bone::upright(chest.end, neck_frame, 0.045 * h);
        let head = Bone::upright(neck.end, pose.head_frame(1.0), 0.128 * h * build.head);

        let breadth = h * build.shoulders * (0.09 + 0.015 * build.sex);
        let sides = [0, 1];
        let upper_arms = sides.map(|side| {
            let [abduct, raise, inwards, _] = pose.arms[side];
            let start = chest.at(0.85, Vec3::new(sign(side) * breadth, -0.005 * h, 0.0));
            let frame = chest_frame
                * rotate_x(-raise)
                * rotate_z(sign(side) * abduct)
                * rotate_y(-sign(side) * inwards);
            Bone::upright(start, frame, -0.172 * h * build.arms)
        });
        let forearms = sides.map(|side| {
            let frame = upper_arms[side].frame * rotate_x(-pose.arms[side][3]);
            Bone::upright(upper_arms[side].end, frame, -0.146 * h * build.arms)
        });
        let hands = sides.map(|side| {
            // Palms towards the thighs.
            let frame = forearms[side].frame * rotate_y(-sign(side) * 70.0) * rotate_x(-8.0);
            Bone::upright(forearms[side].end, frame, -0.1 * h)
        });

        let thighs = sides.map(|side| {
            let [forward, apart, _] = pose.legs[side];
            let start = pelvis.at(0.0, Vec3::new(sign(side) * 0.051 * h, -0.005 * h, 0.0));
            let out = sign(side) * 0.5 * pose.toes[side];
            let frame = pelvis_frame * rotate_x(-forward) * rotate_z(sign(side) * apart) * rotate_y(out);
            Bone::upright(start, frame, -0.245 * h * build.legs)
        });
        let calves = sides.map(|side| {
            let frame = thighs[side].frame * rotate_x(pose.legs[side][2]);
            Bone::upright(thighs[side].end, frame, -0.246 * h * build.legs)
        });
        let feet = sides.map(|side| {
            // Feet stay flat. The heel lifts only if the calf leans far forwards.
            let calf = calves[side].frame;
            let lifted = (calf.y_axis.z.clamp(-1.0, 1.0) * 45.0 - 6.0).max(0.0);
            let out = sign(side) * (9.0 + pose.toes[side]);
            let frame = rotate_y(0.3 * turn + out) * rotate_x(lifted);
            Bone::upright(calves[side].end, frame, -0.039 * h)
        });
        let fingers = pose.fingers;
        Self { build, fingers, pelvis, chest, neck, head, upper_arms, forearms, hands, thighs, calves, feet }
    }
}
