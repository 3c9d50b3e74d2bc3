//! `snapsnap demo`: Gaussians, pictures and a report of the program's sample pair.

use std::path::PathBuf;
use std::time::Instant;

use clap::Args;
use image::imageops::FilterType;
use image::{DynamicImage, RgbImage, imageops};
use serde_json::json;
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::{Region, margin};
use snapsnap_eval::similarity::psnr;
use snapsnap_photo::{Cutting, Source, Told};
use snapsnap_splat::{Camera, Gaussians, RenderOptions, render, scene};

use crate::failure::Failure;
use crate::model::ModelArguments;
use crate::pictures::{read_back, sheet, write_png};
use crate::progress::Progress;
use crate::report::{REPORT, ReportFolder, header};
use crate::turntable::Turntable;
use crate::{device, output, say};

const FILES: &[&str] = &[
    "front.png",
    "back.png",
    "human.ply",
    "turntable.gif",
    "turntable.png",
    "comparison.png",
    "report.md",
    REPORT,
];

/// Front and back of a held-out synthetic person through the nominal cameras, RGBA, `[1024, 1024]`.
const PHOTOGRAPHS: [(&str, &[u8]); 2] = [
    ("front.png", include_bytes!("../../../../assets/sample/front.png")),
    ("back.png", include_bytes!("../../../../assets/sample/back.png")),
];
/// Ground truth of other cameras: degrees around the person from the front, and a picture of [`TRUTH`]² over black.
const TRUTHS: [(f64, &[u8]); 3] = [
    (45.0, include_bytes!("../../../../assets/sample/45.png")),
    (135.0, include_bytes!("../../../../assets/sample/135.png")),
    (270.0, include_bytes!("../../../../assets/sample/270.png")),
];
const TRUTH: u32 = 512;
/// First and last columns of the ground truth in the comparison.
const COLUMNS: [u32; 2] = [144, 368];

#[derive(Args)]
pub struct Arguments {
    /// Folder for the Gaussians, pictures and report.
    #[arg(short, long, value_name = "DIR", default_value = "demo")]
    output: PathBuf,
    /// auto, cpu, ndarray, wgpu, vulkan, cuda or metal; wgpu:1 is the second adapter.
    #[arg(long, default_value = "auto")]
    device: String,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let start = Instant::now();
    let folder = ReportFolder::of(&arguments.output, FILES, &[])?;
    let device = device::choose_for_one(&arguments.device)?;
    let progress = Progress::stages();
    progress.stage("photographs");
    let header = header(&device::describe(&device));
    // Written first, so that the next demo may replace the files of an interrupted one.
    folder.text(REPORT, &header.json().to_string())?;
    for (name, bytes) in PHOTOGRAPHS {
        output::write(&folder.file(name), bytes)?;
    }
    let model = ModelArguments::new(None, &arguments.device);
    let weights = model.open()?;
    let config = &weights.config;
    let since = Instant::now();
    // The sample pair fills its canvas. Hence its cameras are known, and other views can be compared.
    let photographs = PHOTOGRAPHS.map(|(name, _)| folder.path.join(name));
    let sources = photographs.each_ref().map(|path| Source::file(path));
    let told = Told { as_is: true, ..Told::default() };
    let side = config.network.resolution;
    let read = snapsnap_photo::read(&sources, Cutting::Given, side, told.placement(config), None)?;
    let (networks, _) = model.load(&weights, &device)?;
    let made = snapsnap_photo::person(&read, &networks, &told, &|name| progress.stage(name));
    let world = made?.gaussians;
    let seconds = since.elapsed().as_secs_f64();
    progress.stage("writing");
    scene::write(&world, &folder.file("human.ply"))?;
    drop(progress);
    for name in ["turntable.gif", "turntable.png"] {
        Turntable::new(&folder.file(name))?.write(&world)?;
    }
    let (pictures, errors) = comparison(&world)?;
    write_png(&folder.file("comparison.png"), &sheet(&pictures, pictures.len() as u32))?;

    let mut text = header.markdown("Demo");
    text += &format!(
        "* {} Gaussians in {seconds:.1} s, photographs and weights read; all of it in {:.1} s\n\
         * The photographs are the canvases, as with `--as-is`: a few Gaussians fewer or more than `reconstruct` makes of \
         them\n\n\
         ![turntable](turntable.png)\n\nThe photographs, then unseen views beside the ground truth:\n\n\
         ![comparison](comparison.png)\n\n| seen from | PSNR on the person, dB |\n|---|---|\n",
        world.len(),
        start.elapsed().as_secs_f64(),
    );
    for (degrees, psnr) in &errors {
        text += &format!("| {degrees}° | {psnr:.2} |\n");
    }
    folder.text("report.md", &text)?;
    let mut value = header.json();
    value["gaussians"] = json!(world.len());
    value["reconstruction_s"] = json!(seconds);
    value["psnr_masked"] = errors.iter().map(|(degrees, psnr)| (format!("{degrees}"), json!(psnr))).collect();
    folder.finish(&value)?;
    for name in FILES {
        say::info(&arguments.output.join(name).display().to_string());
    }
    Ok(())
}

/// The degrees of a view, and its PSNR on the person, dB.
type Agreement = (f64, f64);

/// The photographs, then each rendered view and its ground truth, and how they agree.
fn comparison(world: &Gaussians) -> Result<(Vec<RgbImage>, Vec<Agreement>), Failure> {
    let side = TRUTH as usize;
    let mut pictures = Vec::new();
    for (name, bytes) in PHOTOGRAPHS {
        let small = decoded(name, bytes)?.resize_exact(TRUTH, TRUTH, FilterType::Triangle);
        pictures.push(Picture::from_file(small, "photograph")?.to_rgb8());
    }
    let mut errors = Vec::new();
    for (degrees, bytes) in TRUTHS {
        let truth = decoded("true picture", bytes)?;
        let mask: Vec<f32> = truth.to_rgba8().pixels().map(|pixel| f32::from(pixel[3]) / 255.0).collect();
        let truth = Picture::from_file(truth, "true picture")?;
        // Rendered at twice the size and shrunk, as in `evaluate`.
        let camera = Camera::orbit_at_yaw_degrees(degrees, 2 * TRUTH);
        let rendered = render(world, &[camera], &RenderOptions::inria())?;
        let made = Picture::rendered(&read_back(rendered.color)?, [2 * side; 2], 2)?;
        let person = Region::masked(&mask, [side; 2], margin(side))?;
        errors.push((degrees, psnr(&made, &truth, &person)?));
        pictures.extend([made.to_rgb8(), truth.to_rgb8()]);
    }
    let [left, right] = COLUMNS;
    let cut = |picture: &RgbImage| imageops::crop_imm(picture, left, 0, right - left, TRUTH).to_image();
    Ok((pictures.iter().map(cut).collect(), errors))
}

fn decoded(name: &str, bytes: &[u8]) -> Result<DynamicImage, Failure> {
    image::load_from_memory(bytes).map_err(|e| Failure::Internal(format!("the sample's {name}: {e}")))
}
