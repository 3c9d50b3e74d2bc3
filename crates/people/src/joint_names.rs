//! Names of joints in files of characters and motions.

/// Known joints, from the hips to the ends of the limbs. [`need`] names them as Mixamo does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Name {
    Hips,
    Spine,
    Neck,
    Head,
    Clavicle,
    Shoulder,
    Arm,
    ForeArm,
    Hand,
    /// A joint of the index, middle, ring or small finger, 2 to 5.
    Finger(u8),
    UpLeg,
    Leg,
    Foot,
    Toe,
}

/// The joint that `name` denotes, and its side, by the conventions of Mixamo (`mixamorig:LeftArm`) and MakeHuman
/// (`upperarm01.L`, `upperarm_l`).
pub fn known(name: &str) -> Option<(Name, usize)> {
    let name = name.rsplit(':').next()?.to_lowercase();
    let name = name.strip_prefix("mixamorig").unwrap_or(&name).trim_start_matches('_');
    let mut sides = [("left", 'l'), ("right", 'r')].into_iter().enumerate();
    let sided = sides.find_map(|(side, (word, letter))| {
        let short = || name.strip_suffix(letter)?.strip_suffix(['.', '_']);
        Some((name.strip_prefix(word).or_else(short)?, side))
    });
    let (base, side) = sided.unwrap_or((name, 0));
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
        "arm" | "upperarm" => Name::Arm,
        "forearm" | "lowerarm" => Name::ForeArm,
        "hand" | "wrist" => Name::Hand,
        "handindex" | "index" => Name::Finger(2),
        "handmiddle" | "middle" => Name::Finger(3),
        "handring" | "ring" => Name::Finger(4),
        "handpinky" | "pinky" => Name::Finger(5),
        "finger" => Name::Finger(base.strip_prefix("finger")?.bytes().next()?.checked_sub(b'0')?),
        "upleg" | "upperleg" | "thigh" => Name::UpLeg,
        "leg" | "lowerleg" | "calf" => Name::Leg,
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
    let side_word = match name {
        Name::Hips | Name::Spine | Name::Neck | Name::Head => "",
        _ => ["Left", "Right"][side],
    };
    find(joints, name, side).ok_or_else(|| {
        format!("has no joint `{side_word}{name:?}`: expected the joint names of Mixamo or MakeHuman")
    })
}
