//! Names of joints in files of characters and motions.

/// Known joints, from the hips to the ends of the limbs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Name {
    Hips,
    Spine,
    Neck,
    Head,
    Clavicle,
    Shoulder,
    UpperArm,
    Forearm,
    Hand,
    /// A joint of the index, middle, ring or small finger, 2 to 5.
    Finger(u8),
    Thigh,
    Calf,
    Foot,
    Toe,
}

/// The joint that `name` denotes, and its side, by the conventions of Mixamo (`mixamorig:LeftArm`) and MakeHuman
/// (`upperarm01.L`, `upperarm_l`).
pub fn known(name: &str) -> Option<(Name, usize)> {
    let name = name.rsplit(':').next()?.to_lowercase();
    let name = name.strip_prefix("mixamorig").unwrap_or(&name).trim_start_matches('_');
    let side = |name: &str| -> (String, usize) {
        for (side, word, letter) in [(0, "left", 'l'), (1, "right", 'r')] {
            if let Some(rest) = name.strip_prefix(word) {
                return (rest.to_owned(), side);
            }
            if let Some(rest) = name.strip_suffix(letter).and_then(|rest| rest.strip_suffix(['.', '_'])) {
                return (rest.to_owned(), side);
            }
        }
        (name.to_owned(), 0)
    };
    let (base, side) = side(name);
    let stem = base.trim_end_matches(|c: char| c.is_ascii_digit() || c == '_' || c == '-');
    let name = match stem {
        "hips" | "pelvis" | "root" => Name::Hips,
        "spine" => Name::Spine,
        "neck" => Name::Neck,
        "head" => Name::Head,
        "clavicle" => Name::Clavicle,
        // MakeHuman's shoulder01 lies between collarbone and arm, Mixamo's is the collarbone.
        "shoulder" if base == "shoulder01" => Name::Shoulder,
        "shoulder" => Name::Clavicle,
        "arm" | "upperarm" => Name::UpperArm,
        "forearm" | "lowerarm" => Name::Forearm,
        "hand" | "wrist" => Name::Hand,
        "handindex" | "index" => Name::Finger(2),
        "handmiddle" | "middle" => Name::Finger(3),
        "handring" | "ring" => Name::Finger(4),
        "handpinky" | "pinky" => Name::Finger(5),
        "finger" => Name::Finger(base.strip_prefix("finger")?.bytes().next()?.checked_sub(b'0')?),
        "upleg" | "upperleg" | "thigh" => Name::Thigh,
        "leg" | "lowerleg" | "calf" => Name::Calf,
        "foot" => Name::Foot,
        "toebase" | "toe" | "ball" => Name::Toe,
        _ => return None,
    };
    Some((name, side)).filter(|(name, _)| !matches!(name, Name::Finger(0 | 1 | 6..)))
}

/// Index of the first joint of this name among the [`known`] joints of a file.
pub fn find(joints: &[Option<(Name, usize)>], name: Name, side: usize) -> Option<usize> {
    joints.iter().position(|joint| *joint == Some((name, side)))
}

/// As [`find`].
///
/// # Errors
/// A sentence that names the missing joint.
pub fn need(joints: &[Option<(Name, usize)>], name: Name, side: usize) -> Result<usize, String> {
    let word = match name {
        Name::Hips => "Hips".to_owned(),
        Name::Spine => "Spine".to_owned(),
        Name::Neck => "Neck".to_owned(),
        Name::Head => "Head".to_owned(),
        _ => {
            let side = if side == 0 { "Left" } else { "Right" };
            let word = match name {
                Name::UpperArm => "Arm",
                Name::Forearm => "ForeArm",
                Name::Hand => "Hand",
                Name::Thigh => "UpLeg",
                Name::Calf => "Leg",
                _ => "Foot",
            };
            format!("{side}{word}")
        }
    };
    find(joints, name, side)
        .ok_or_else(|| format!("has no joint `{word}`: expected the joint names of Mixamo or MakeHuman"))
}
