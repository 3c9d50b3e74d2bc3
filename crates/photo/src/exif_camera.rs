//! What a file tells about its camera, and the camera's distance and elevation (docs/method.md, "Cameras of a user").

use std::io::{BufReader, Cursor};

use exif::{In, Tag, Value};
use glam::DVec3;
use snapsnap_base::{file, guarded};
use snapsnap_splat::{Camera, Orbit};

use crate::placing::Mapping;
use crate::restoration::PlaneMap;
use crate::source::{Content, Source};

/// Focal lengths of lenses, in millimetres of 35 mm film.
pub const FOCALS: std::ops::RangeInclusive<f64> = 8.0..=1200.0;
/// Plausible elevations of a camera that photographs a standing person, in degrees.
pub const ELEVATIONS: std::ops::RangeInclusive<f64> = -45.0..=60.0;
/// Diagonal of a frame of 35 mm film, in millimetres.
const FILM: f64 = 43.267;
/// First bytes of Apple's maker note, and its entry with the measured acceleration.
const APPLE: &[u8] = b"Apple iOS\0";
const ACCELERATION: u16 = 8;

/// What a file says about its camera.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Shot {
    /// Focal length in millimetres of 35 mm film.
    pub focal: Option<f64>,
    /// How far the optical axis looks down, in degrees.
    pub pitch: Option<f64>,
}

impl Shot {
    /// Reads the file's EXIF data. Missing or damaged data give nothing.
    pub fn of(source: &Source) -> Self {
        let reader = exif::Reader::new();
        let read = || match source.content {
            Content::File => {
                reader.read_from_container(&mut BufReader::new(file::open(source.path).ok()?)).ok()
            }
            Content::Bytes(bytes) => reader.read_from_container(&mut Cursor::new(bytes)).ok(),
            Content::Pixels(..) => None,
        };
        let Ok(Some(exif)) = guarded(source.path, || Ok(read())) else { return Self::default() };
        let field = |tag| exif.get_field(tag, In::PRIMARY).map(|field| &field.value);
        let focal = field(Tag::FocalLengthIn35mmFilm).and_then(|value| value.get_uint(0));
        // The camera beside the screen looks the other way, so the pitch would be wrong.
        let is_selfie = field(Tag::LensModel).is_some_and(|lens| matches!(lens, Value::Ascii(texts) if texts.iter().any(|text| text.windows(5).any(|part| part == b"front"))));
        let pitch = match field(Tag::MakerNote) {
            Some(Value::Undefined(note, _)) if !is_selfie => pitch(note),
            _ => None,
        };
        Self { focal: focal.map(f64::from).filter(|focal| FOCALS.contains(focal)), pitch }
    }
}

/// How far the optical axis looks down, in degrees, by Apple's maker note.
fn pitch(note: &[u8]) -> Option<f64> {
    // Axes of a telephone seen from its front: x left, y down, z into it, which is the direction of the camera at its
    // back. The acceleration is opposite to gravity.
    let up = acceleration(note).filter(|up| (0.8..1.2).contains(&up.length()))?;
    Some((-up.z / up.length()).asin().to_degrees())
}

/// The acceleration in units of gravity from Apple's maker note, a TIFF directory with offsets from the note's start.
fn acceleration(note: &[u8]) -> Option<DVec3> {
    let bytes = |at: usize, length: usize| note.get(at..at.checked_add(length)?);
    let short = |at| bytes(at, 2).map(|b| u16::from_be_bytes([b[0], b[1]]));
    let long = |at| bytes(at, 4).map(|b| u32::from_be_bytes([b[0], b[1], b[2], b[3]]));
    if !note.starts_with(APPLE) || bytes(12, 2)? != b"MM" {
        return None;
    }
    let entry =
        (0..usize::from(short(14)?)).map(|i| 16 + 12 * i).find(|at| short(*at) == Some(ACCELERATION))?;
    // Three signed fractions.
    if short(entry + 2)? != 10 || long(entry + 4)? != 3 {
        return None;
    }
    let place = long(entry + 8)? as usize;
    let fraction = |i: usize| {
        let [a, b] = [long(place + 8 * i)?, long(place + 8 * i + 4)?].map(|part| f64::from(part as i32));
        (b != 0.0).then(|| a / b)
    };
    Some(DVec3::new(fraction(0)?, fraction(1)?, fraction(2)?))
}

/// What is known about the camera of a photograph, after the photograph was turned.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// Focal length and pitch, from the file or the user.
    pub shot: Shot,
    /// Width and height of the photograph in pixels.
    pub size: [u32; 2],
    /// Map from the photograph to the canvas.
    pub mapping: Mapping,
}

/// Place of a camera relative to the body's middle, in metres of the networks' person.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Viewpoint {
    /// How far the camera looks down at the body's middle, in degrees.
    pub elevation: f64,
    /// Distance of the camera from the body's middle.
    pub distance: f64,
}

impl Default for Viewpoint {
    /// The nominal camera.
    fn default() -> Self {
        let Orbit { pitch_degrees: elevation, radius: distance, .. } = Orbit::default();
        Self { elevation, distance }
    }
}

impl Viewpoint {
    /// The distance in metres from which a lens of `focal` millimetres of 35 mm film sees a person of this size on a
    /// canvas of `side` pixels.
    pub fn distance(focal: f64, frame: &Frame, side: usize) -> f64 {
        let Orbit { focal: nominal, radius, .. } = Orbit::default();
        radius * pixels(focal, frame.size) * frame.mapping.scale.y / (nominal * side as f64)
    }

    /// The angle in degrees by which a camera looks down at the body's middle if its optical axis looks down by
    /// `pitch` degrees. The other arguments are as in [`Self::distance`].
    pub fn elevation(pitch: f64, focal: f64, frame: &Frame, side: usize) -> f64 {
        let principal = Orbit::default().camera(side as u32).principal_point;
        let below = frame.mapping.source(principal).y - f64::from(frame.size[1]) / 2.0;
        pitch + (below / pixels(focal, frame.size)).atan().to_degrees()
    }

    /// Height of a person on the body's axis over its height in the nominal camera, which takes the same picture.
    /// Infinite if there is none.
    pub fn stretch(&self) -> f64 {
        // The lowest and the highest point of the nominal person, in metres.
        const ENDS: [f64; 2] = [0.04, 1.83];
        let maps =
            PlaneMap::new(&Self::default().camera(0.0, 1), &self.camera(0.0, 1), &Mapping::AS_IT_IS, 1.0);
        match ENDS.map(|y| maps.apply(DVec3::new(0.0, y, 0.0))) {
            [Some(low), Some(high)] => (high.y - low.y) / (ENDS[1] - ENDS[0]),
            _ => f64::INFINITY,
        }
    }

    /// The camera of this viewpoint on a canvas of `side` pixels, `yaw_degrees` around the person from the front.
    /// World: y up, the front camera above +z.
    pub fn camera(&self, yaw_degrees: f64, side: u32) -> Camera {
        let nominal = Orbit::default();
        // The person has the same size on the canvas.
        let focal = nominal.focal * self.distance / nominal.radius;
        Orbit { yaw_degrees, pitch_degrees: self.elevation, radius: self.distance, focal, ..nominal }
            .camera(side)
    }
}

/// Converts a focal length of 35 mm film into pixels of a picture.
pub(super) fn pixels(focal: f64, picture: [u32; 2]) -> f64 {
    focal / FILM * f64::from(picture[0]).hypot(f64::from(picture[1]))
}

#[cfg(test)]
mod tests {
    use glam::DVec2;

    use super::*;

    /// Apple's note with this acceleration in thousandths.
    fn note(acceleration: [i32; 3]) -> Vec<u8> {
        let mut note = [
            APPLE,
            b"\0\x01MM",
            &[0, 1],
            &ACCELERATION.to_be_bytes(),
            &[0, 10, 0, 0, 0, 3],
            &32_u32.to_be_bytes(),
            &[0; 4],
        ]
        .concat();
        assert_eq!(note.len(), 32);
        acceleration
            .iter()
            .for_each(|value| note.extend([value.to_be_bytes(), 1000_i32.to_be_bytes()].concat()));
        note
    }

    #[test]
    fn telephones_tell_their_pitch() {
        // Upright, and looking down by 10°.
        let whole = note([0, -1000, 0]);
        assert_eq!(pitch(&whole), Some(0.0));
        let down = pitch(&note([0, -985, -174])).expect("a pitch");
        assert!((down - 10.0).abs() < 0.1, "{down}");
        // A telephone that is being shaken tells nothing, and neither does a part of a note.
        assert_eq!(pitch(&note([0, -2000, 0])), None);
        assert!((0..whole.len()).all(|length| pitch(&whole[..length]).is_none()));
    }

    #[test]
    fn distances_follow_from_the_lens() {
        // The nominal camera's field: 0.8 of the side of a square.
        let focal = 0.8 * FILM / 2.0_f64.sqrt();
        let mapping = Mapping { scale: DVec2::splat(1.024), origin: DVec2::ZERO };
        let frame = Frame { shot: Shot::default(), size: [1000, 1000], mapping };
        assert!((Viewpoint::distance(focal, &frame, 1024) - 2.0).abs() < 1e-9);
        assert!((Viewpoint::distance(2.0 * focal, &frame, 1024) - 4.0).abs() < 1e-9);
        // The body's middle is 25 of 1024 pixels below the picture's middle.
        let elevation = Viewpoint::elevation(3.0, focal, &frame, 1024);
        assert!((elevation - 3.0 - (25.0_f64 / 819.2).atan().to_degrees()).abs() < 1e-6, "{elevation}");
    }
}
