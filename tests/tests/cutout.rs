//! Photographs with a background: the matting network, the edges and colours of cut-outs, and the options.

use std::path::{Path, PathBuf};

use burn::tensor::Device;
use image::{Rgb, RgbImage, RgbaImage};
use snapsnap_net::blazepose::{BlazePose, Pose};
use snapsnap_net::u2net::U2Net;
use snapsnap_net::weights::Source;
use snapsnap_tests::sample::{over, paths, picture, reconstruct};
use snapsnap_tests::{assert_says, data, refused, root, succeed};

/// A wall that gets darker to the right, a window, a floor, and noise.
fn room(x: u32, y: u32) -> [f32; 3] {
    let (across, down) = (x as f32 / 1024.0, y as f32 / 1024.0);
    let noise =
        (x.wrapping_mul(2_654_435_761) ^ y.wrapping_mul(2_246_822_519)).wrapping_mul(3_266_489_917) >> 24;
    let color = if down > 0.82 {
        [120.0, 90.0 + 20.0 * across, 70.0]
    } else if (0.75..0.95).contains(&across) && (0.1..0.5).contains(&down) {
        [150.0, 180.0, 220.0]
    } else {
        [200.0 - 60.0 * across, 190.0 - 50.0 * across, 180.0 - 40.0 * across]
    };
    color.map(|value| value + noise as f32 / 32.0 - 4.0)
}

/// Front and back of the sample in the room.
fn pair(folder: &Path) -> [PathBuf; 2] {
    ["front", "back"].map(|side| {
        let path = folder.join(format!("{side} in a room.png"));
        over(&picture(side), room).save(&path).expect("written");
        path
    })
}

fn share(of: impl Iterator<Item = bool>) -> f64 {
    let (set, all) = of.fold((0, 0), |(set, all), one| (set + u32::from(one), all + 1));
    f64::from(set) / f64::from(all)
}

/// Every n-th pixel of the sample's front over a coloured ramp, `[3, SIDE, SIDE]`, as the converters make it.
fn over_a_ramp(side: u32) -> Vec<f32> {
    let front = picture("front");
    let at = |row: u32| row * front.width() / side;
    let value = |channel: usize| {
        let front = &front;
        (0..side * side).map(move |i| {
            let (x, y) = (i % side, i / side);
            let pixel = front.get_pixel(at(x), at(y)).0.map(|v| f64::from(v) / 255.0);
            let behind = [f64::from(x) / f64::from(side), f64::from(y) / f64::from(side), 0.4][channel];
            (pixel[3] * pixel[channel] + (1.0 - pixel[3]) * behind) as f32
        })
    };
    (0..3).flat_map(value).collect()
}

fn reference(name: &str) -> Vec<f32> {
    let bytes = std::fs::read(data(name)).expect("reference");
    bytes.as_chunks::<4>().0.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

fn weights(name: &str) -> Source {
    Source::open(&root().join("assets/weights").join(name)).expect("weights")
}

/// The largest difference of every eighth pixel of a mask from the reference.
fn apart(found: &[f32], side: usize, expected: &[f32]) -> f32 {
    let columns = side / 8;
    assert_eq!(expected.len(), columns * columns);
    let apart = expected.iter().enumerate().map(|(i, expected)| {
        (found[(8 * (i / columns) + 4) * side + 8 * (i % columns) + 4] - expected).abs()
    });
    apart.fold(0.0, f32::max)
}

/// `docs/u2netp_convert.py` wrote the reference: ONNX Runtime's output for the same picture, at every eighth pixel.
#[test]
fn the_salience_network_computes_what_onnx_runtime_does() {
    let device = Device::flex();
    let network = U2Net::load(&weights("u2netp.safetensors"), &device).expect("weights");
    let largest = apart(&network.forward(&over_a_ramp(320), &device), 320, &reference("u2netp.f32"));
    println!("largest difference {largest:e}");
    assert!(largest < 1e-3, "{largest}");
}

/// `docs/blazepose_convert.py` wrote the reference: LiteRT's landmarks, presence, and logits of every eighth pixel.
#[test]
fn the_pose_network_computes_what_litert_does() {
    let device = Device::flex();
    let network = BlazePose::load(&weights("blazepose.safetensors"), &device).expect("weights");
    let Pose { landmarks, presence, mask } = network.forward(&over_a_ramp(256), &device);
    let expected = reference("blazepose.f32");
    let (expected_landmarks, rest) = expected.split_at(195);
    let found = landmarks.as_flattened();
    assert_eq!(found.len(), 195);
    // In pixels of the picture and in logits.
    let largest = found.iter().zip(expected_landmarks).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    let logits: Vec<f32> = rest[1..].iter().map(|logit| 1.0 / (1.0 + (-logit).exp())).collect();
    let masks = apart(&mask, 256, &logits);
    println!("largest differences: landmarks {largest:e}, mask {masks:e}");
    assert!(largest < 1e-3 && masks < 1e-3 && (presence - rest[0]).abs() < 1e-3, "{largest} {masks}");
}

#[test]
fn people_in_a_room_are_cut_out() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let photographs = pair(temporary.path());
    let cutouts = temporary.path().join("a/b");
    let said =
        succeed(reconstruct(temporary.path(), &photographs).arg("-v").arg("--save-cutouts").arg(&cutouts));
    assert!(said.contains("cut out by the network"), "{said}");
    assert!(temporary.path().join("human.ply").exists());
    for side in ["front", "back"] {
        let (truth, photograph) = (picture(side), over(&picture(side), room));
        let found = image::open(cutouts.join(format!("{side}.png"))).expect("a cut-out").to_rgba8();
        assert_eq!(found.dimensions(), truth.dimensions());
        let inside = |picture: &RgbaImage| picture.pixels().map(|p| p[3] > 127).collect::<Vec<_>>();
        let (own, expected) = (inside(&found), inside(&truth));
        let both = own.iter().zip(&expected).filter(|(a, b)| **a && **b).count() as f64;
        let union = own.iter().zip(&expected).filter(|(a, b)| **a || **b).count() as f64;
        println!("{side}: IoU {:.4}", both / union);
        assert!(both / union > 0.985, "{side}: {}", both / union);
        // Mixed pixels are closer to the person's colour than they were in the photograph.
        let distance = |a: &[u8], b: &[u8]| (0..3).map(|c| u32::from(a[c].abs_diff(b[c]))).sum::<u32>();
        let mixed = truth
            .enumerate_pixels()
            .filter(|(x, y, p)| (40..216).contains(&p[3]) && found.get_pixel(*x, *y)[3] > 127);
        let [mut before, mut after] = [0, 0];
        for (x, y, pixel) in mixed {
            before += distance(&photograph.get_pixel(x, y).0, &pixel.0);
            after += distance(&found.get_pixel(x, y).0, &pixel.0);
        }
        println!("{side}: colour errors of mixed pixels {before} before, {after} after");
        assert!(after * 4 < before * 3, "{side}: {before} {after}");
        assert!(
            share(found.pixels().map(|p| p[3] == 0 && p.0 != [0; 4])) == 0.0,
            "nothing stays behind the mask"
        );
    }
}

#[test]
fn alpha_channels_win_unless_the_network_is_asked_for() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let photographs = paths();
    let cutouts = temporary.path().join("cutouts");
    succeed(reconstruct(temporary.path(), &photographs).arg("--save-cutouts").arg(&cutouts));
    let alpha = |path: &Path| -> Vec<u8> {
        image::open(path).expect("a picture").to_rgba8().pixels().map(|p| p[3]).collect()
    };
    assert!(alpha(&cutouts.join("front.png")) == alpha(&photographs[0]), "the alpha channel is the mask");
    let mut network = reconstruct(temporary.path(), &photographs);
    assert_says(&succeed(network.args(["-v", "--cutout", "network"])), &["cut out by the network"]);
}

#[test]
fn what_cannot_be_cut_out_is_refused() {
    let temporary = tempfile::tempdir().expect("temporary folder");
    let photographs = pair(temporary.path());
    let none = refused(reconstruct(temporary.path(), &photographs).args(["--cutout", "none"]));
    assert!(none.contains("front in a room.png") && none.contains("--cutout auto"), "{none}");
    let mut masked = reconstruct(temporary.path(), &photographs);
    let masks = refused(masked.args(["--cutout", "network", "--masks"]).args(paths()));
    assert!(masks.contains("--masks already"), "{masks}");
    // A wall alone.
    let empty = ["a.png", "b.png"].map(|name| {
        let path = temporary.path().join(name);
        RgbImage::from_pixel(200, 300, Rgb([180, 170, 160])).save(&path).expect("written");
        path
    });
    assert_says(&refused(&mut reconstruct(temporary.path(), &empty)), &["a.png", "no person was found"]);
    assert!(!temporary.path().join("human.ply").exists());
}
