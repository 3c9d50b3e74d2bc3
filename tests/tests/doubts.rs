//! Doubts about photographs that do not show the front and the back of one upright person.

use std::path::{Path, PathBuf};

use image::{DynamicImage, GrayImage, Luma, RgbaImage, imageops};
use snapsnap_tests::sample::{picture, reconstruct};
use snapsnap_tests::{ended_with, refused, root, snapsnap, succeed};
use tempfile::TempDir;

/// A temporary folder with the sample, each picture changed.
fn pair(change: impl Fn(RgbaImage) -> RgbaImage) -> (TempDir, [PathBuf; 2]) {
    let folder = tempfile::tempdir().expect("temporary folder");
    let photographs = ["front", "back"].map(|side| {
        let path = folder.path().join(format!("{side}.png"));
        change(picture(side)).save(&path).expect("written");
        path
    });
    (folder, photographs)
}

/// The message of --strict, which writes nothing.
fn strict(folder: &Path, photographs: &[PathBuf; 2], more: &[PathBuf]) -> String {
    let said = refused(reconstruct(folder, photographs).arg("--strict").args(more));
    assert!(said.contains("--strict") && !folder.join("human.ply").exists(), "{said}");
    said
}

#[test]
fn the_sample_raises_no_doubt() {
    let (temporary, photographs) = pair(|picture| picture);
    let said = ended_with(0, reconstruct(temporary.path(), &photographs).arg("--strict"));
    assert!(!said.contains("warning"), "{said}");
}

#[test]
fn an_inverted_mask_is_noticed() {
    let (temporary, photographs) = pair(|picture| picture);
    let masks = ["front", "back"].map(|side| {
        let own = picture(side);
        let inverted = |x, y| Luma([255 - own.get_pixel(x, y)[3]]);
        let path = temporary.path().join(format!("{side}_mask.png"));
        GrayImage::from_fn(own.width(), own.height(), inverted).save(&path).expect("written");
        path
    });
    let more: Vec<PathBuf> = ["--masks".into()].into_iter().chain(masks).collect();
    let said = strict(temporary.path(), &photographs, &more);
    assert!(said.contains("touches 4 borders") && said.contains("is it inverted?"), "{said}");
}

#[test]
fn a_hole_in_the_torso_is_noticed() {
    let (temporary, photographs) = pair(|mut picture| {
        for (x, y, pixel) in picture.enumerate_pixels_mut() {
            let is_hole = x.abs_diff(512).pow(2) + y.abs_diff(320).pow(2) < 30 * 30;
            pixel.0[3] = if is_hole { 0 } else { pixel.0[3] };
        }
        picture
    });
    let said = strict(temporary.path(), &photographs, &[]);
    assert!(said.matches("the mask has a hole in the person's torso").count() == 2, "{said}");
}

#[test]
fn somebody_who_lies_is_noticed() {
    let (temporary, photographs) = pair(|picture| DynamicImage::from(picture).rotate90().to_rgba8());
    let said = strict(temporary.path(), &photographs, &[]);
    assert!(said.contains("wider than high"), "{said}");
}

#[test]
fn one_picture_in_place_of_two_is_noticed_and_taken() {
    let (temporary, [front, _]) = pair(|picture| picture);
    let twice = [front.clone(), front.clone()];
    assert!(strict(temporary.path(), &twice, &[]).contains("the same picture twice"));
    let flipped = temporary.path().join("flipped.png");
    imageops::flip_horizontal(&picture("front")).save(&flipped).expect("written");
    assert!(strict(temporary.path(), &[front, flipped], &[]).contains("mirror image"));
    let said = ended_with(0, &mut reconstruct(temporary.path(), &twice));
    assert_eq!(said.matches("warning: ").count(), 1, "{said}");
    assert_eq!(ended_with(0, reconstruct(temporary.path(), &twice).arg("--quiet")), "");
}

#[test]
fn silhouettes_that_do_not_fit_are_noticed() {
    let (temporary, [front, back]) = pair(|picture| picture);
    let mut other = picture("back");
    let (width, height) = other.dimensions();
    // A cross from corner to corner.
    for (x, y, pixel) in other.enumerate_pixels_mut() {
        let (u, v) = (x as f32 / width as f32, y as f32 / height as f32);
        let inside = (0.3..0.7).contains(&u) && (0.1..0.9).contains(&v);
        let along = (u - 0.3) / 0.4 - (v - 0.1) / 0.8;
        let across = (u - 0.3) / 0.4 + (v - 0.1) / 0.8 - 1.0;
        pixel.0 = [x as u8, y as u8, 90, if inside && along.abs().min(across.abs()) < 0.1 { 255 } else { 0 }];
    }
    other.save(&back).expect("written");
    let said = strict(temporary.path(), &[front, back], &[]);
    assert!(said.contains("silhouettes") && said.contains("back.png: nobody is recognised"), "{said}");
}

/// A nearer arm is wider: this person's boxes in front and back are 677 and 563 of 1024 pixels wide.
#[test]
fn an_outstretched_arm_raises_no_doubt() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let mut prepare = snapsnap();
    prepare.args(["prepare", "synth", "--subjects", "1", "--seed", "77021", "--split", "test", "--config"]);
    prepare.arg(root().join("configs/data/evaluation.toml")).args(["--set", "views.count=4"]);
    succeed(prepare.args(["--set", "views.resolution=256", "-o"]).arg(temporary.path().join("people")));
    let view = |view: u32| temporary.path().join(format!("people/test/img/0000/{view}.png"));
    let said = strict(temporary.path(), &[view(0), view(1)], &[]);
    assert!(said.contains("silhouettes"), "{said}");
    let mut command = reconstruct(temporary.path(), &[view(0), view(2)]);
    succeed(command.args(["--strict", "--set", "network.resolution=256"]));
}

/// The person's box decides the scale. A few pixels in a corner do not widen it.
#[test]
fn a_distant_speck_of_the_mask_changes_nothing() {
    let gaussians = |speck: bool| {
        let (folder, photographs) = pair(|mut picture| {
            if speck {
                let opaque = |(x, y): (u32, u32)| (x + 3, y + 3, image::Rgba([200, 10, 10, 255]));
                let all = (0..20).flat_map(|y| (0..20).map(move |x| (x, y))).map(opaque);
                all.for_each(|(x, y, pixel)| picture.put_pixel(x, y, pixel));
            }
            picture
        });
        let mut command = reconstruct(folder.path(), &photographs);
        let said = succeed(command.args(["--set", "network.resolution=256", "-v"]));
        assert_eq!(said.contains("1 specks of the mask left out"), speck, "{said}");
        std::fs::read(folder.path().join("human.ply")).expect("a PLY")
    };
    assert!(gaussians(false) == gaussians(true));
}

#[test]
fn swapped_pictures_are_exchanged() {
    let (temporary, [front, back]) = pair(|picture| picture);
    let said = strict(temporary.path(), &[back.clone(), front.clone()], &[]);
    assert!(said.contains("they were exchanged"), "{said}");
    assert!(said.find("back.png") < said.find("front.png"), "in the order given: {said}");
    let gaussians = |photographs: &[PathBuf; 2], name: &str| {
        let folder = temporary.path().join(name);
        std::fs::create_dir(&folder).expect("a folder");
        succeed(reconstruct(&folder, photographs).args(["--set", "network.resolution=256"]));
        std::fs::read(folder.join("human.ply")).expect("a PLY")
    };
    assert!(gaussians(&[back.clone(), front.clone()], "swapped") == gaussians(&[front, back], "right"));
}

/// The sample from the side, the front twice, and the front with parts cut off.
#[test]
fn joints_tell_what_is_wrong() {
    let (temporary, [front, back]) = pair(|picture| picture);
    let side = root().join("assets/sample/270.png");
    let said = strict(temporary.path(), &[side, back.clone()], &[]);
    assert!(said.contains("270.png: the person is seen from the side"), "{said}");
    let other = temporary.path().join("other.png");
    imageops::resize(&picture("front"), 700, 800, imageops::FilterType::Triangle)
        .save(&other)
        .expect("written");
    let said = strict(temporary.path(), &[front.clone(), other], &[]);
    assert!(said.contains("both show the person's front"), "{said}");
    let mut cut = picture("front");
    let mask: GrayImage =
        GrayImage::from_fn(cut.width(), cut.height(), |x, y| Luma([cut.get_pixel(x, y)[3]]));
    let rows: Vec<u32> =
        mask.enumerate_pixels().filter(|(.., share)| share[0] > 127).map(|(_, y, _)| y).collect();
    let (top, height) = (rows[0], rows[rows.len() - 1] - rows[0]);
    let crop = |picture: &mut RgbaImage, y: u32, height: u32| {
        imageops::crop(picture, 0, y, mask.width(), height).to_image()
    };
    for (y, rows, part) in
        [(top + height / 12, height, "head"), (0, top + 8 * height / 10, "left leg, right leg")]
    {
        let path = temporary.path().join("cut.png");
        crop(&mut cut, y, rows).save(&path).expect("written");
        let said = strict(temporary.path(), &[path, back.clone()], &[]);
        assert!(said.contains(&format!("outside of the picture: {part}")), "{part}: {said}");
    }
}

#[test]
fn somebody_else_in_the_picture_is_noticed() {
    let beside = |share: f32| {
        pair(|picture| {
            let (width, height) = picture.dimensions();
            let mut both = RgbaImage::from_pixel(2 * width, height, image::Rgba([120, 130, 125, 255]));
            imageops::overlay(&mut both, &picture, 0, 0);
            let [w, h] = [width, height].map(|side| (share * side as f32) as u32);
            if w > 0 {
                let other = imageops::resize(&picture, w, h, imageops::FilterType::Triangle);
                imageops::overlay(&mut both, &other, width.into(), (height - h).into());
            }
            both.pixels_mut().for_each(|pixel| pixel.0[3] = 255);
            both
        })
    };
    let (folder, photographs) = beside(0.7);
    let said = strict(folder.path(), &photographs, &[]);
    assert_eq!(said.matches("somebody else").count(), 2, "{said}");
    let (folder, photographs) = beside(0.0);
    let mut command = reconstruct(folder.path(), &photographs);
    succeed(command.args(["--strict", "--set", "network.resolution=256"]));
}
