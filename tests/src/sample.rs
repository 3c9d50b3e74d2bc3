//! The sample pair: front and back of a person, with alpha channels.

use std::path::{Path, PathBuf};
use std::process::Command;

use image::{Rgb, RgbImage, RgbaImage};

use crate::{root, snapsnap};

/// The files of front and back.
pub fn paths() -> [PathBuf; 2] {
    ["front.png", "back.png"].map(|name| root().join("assets/sample").join(name))
}

/// The picture of one side, `front` or `back`.
pub fn picture(side: &str) -> RgbaImage {
    let path = root().join(format!("assets/sample/{side}.png"));
    image::open(path).expect("the sample").into_rgba8()
}

/// A picture over a background, whose colour of 0 to 255 depends on the pixel.
pub fn over(picture: &RgbaImage, color: impl Fn(u32, u32) -> [f32; 3]) -> RgbImage {
    RgbImage::from_fn(picture.width(), picture.height(), |x, y| {
        let (own, behind) = (picture.get_pixel(x, y), color(x, y));
        let share = f32::from(own[3]) / 255.0;
        let mixed = |c: usize| share * f32::from(own[c]) + (1.0 - share) * behind[c];
        Rgb([0, 1, 2].map(|c| mixed(c).round() as u8))
    })
}

/// `reconstruct` of a pair on the CPU; writes `human.ply` into the folder.
pub fn reconstruct(folder: &Path, pair: &[PathBuf; 2]) -> Command {
    let mut command = snapsnap();
    command.args(["reconstruct", "--device", "cpu", "-o"]).arg(folder.join("human.ply")).args(pair);
    command
}
