//! `snapsnap compare`.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::{Value, json};
use snapsnap_eval::evaluate::LeftOut;
use snapsnap_eval::lpips::Lpips;
use snapsnap_eval::pictures::Picture;
use snapsnap_eval::region::{Region, margin};
use snapsnap_eval::score::Score;
use snapsnap_eval::similarity::{check_sizes, ssim_of_loss};
use snapsnap_mesh::picture::{self, MAX_BYTES, decode};

use crate::batch::pictures;
use crate::failure::{Failure, bail};
use crate::report::print_left_out;
use crate::{memory, perceptual, say};

/// Bytes per pixel of two pictures: decoded, as planes, and the compared parts.
const BYTES: u64 = 160;

#[derive(Args)]
pub struct Arguments {
    /// Picture, or folder of pictures.
    a: PathBuf,
    /// Ground-truth picture, or folder of pictures with the same names.
    b: PathBuf,
    /// Mask of the person (any value above 0), or a folder of such pictures.
    #[arg(long, value_name = "MASK")]
    mask: Option<PathBuf>,
    /// Compared pixels: all; pixels of the paper's window of 1000 × 500 of 1024 pixels around the pixels of B that are
    /// not black; or the mask and 8 of 1024 pixels around it. Default: the mask if one is given, else all.
    #[arg(long, value_enum)]
    window: Option<Window>,
    /// Pixels around the mask instead of 8 of 1024.
    #[arg(long, value_name = "PIXELS", requires = "mask")]
    margin: Option<usize>,
    #[command(flatten)]
    lpips: perceptual::Arguments,
    /// Device for LPIPS: auto, cpu, ndarray, wgpu, vulkan, cuda or metal.
    #[arg(long, default_value = "auto")]
    device: String,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq, ValueEnum)]
enum Window {
    All,
    Paper,
    Mask,
}

/// Figures of two pictures.
struct Compared {
    score: Score,
    ssim_gaussian: f64,
    region: Region,
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    match (arguments.window, &arguments.mask) {
        (Some(Window::Mask), None) => bail!("--window mask needs --mask MASK"),
        (Some(Window::All | Window::Paper), Some(_)) => bail!("--mask goes with --window mask alone"),
        _ => {}
    }
    let lpips = arguments.lpips.load(perceptual::FOLDER.as_ref(), &arguments.device)?;
    let Arguments { a, b, mask, .. } = arguments;
    if a.is_dir() || b.is_dir() {
        return folders(arguments, &lpips);
    }
    let compared = compare(arguments, a, b, mask.as_deref(), &lpips)?;
    if !arguments.json {
        return say::lines(&text_of(&compared, &lpips));
    }
    let mut value = json_of(&compared);
    value["lpips_weights"] = perceptual::describe(&lpips).into();
    say::json(&value.to_string())
}

fn folders(arguments: &Arguments, lpips: &Result<Lpips, String>) -> Result<(), Failure> {
    let Arguments { a, b, mask, .. } = arguments;
    for path in [Some(a), Some(b), mask.as_ref()].into_iter().flatten() {
        if !path.is_dir() {
            let message = "is no folder: compare two pictures, or two folders of equally named pictures";
            return Err(Failure::file(path, message));
        }
    }
    let (ours, truths) = (pictures_in(a)?, pictures_in(b)?);
    let missing = |folder: &Path| {
        let why = format!("is not in {}", folder.display());
        move |name: &String| LeftOut::new(name, &why)
    };
    let mut left_out: Vec<LeftOut> = ours.difference(&truths).map(missing(b)).collect();
    left_out.extend(truths.difference(&ours).map(missing(a)));
    let mut compared = Vec::new();
    for name in ours.intersection(&truths) {
        let mask = mask.as_ref().map(|folder| folder.join(name));
        match compare(arguments, &a.join(name), &b.join(name), mask.as_deref(), lpips) {
            Ok(found) => compared.push((name, found)),
            Err(failure) => left_out.push(LeftOut::new(name, failure)),
        }
    }
    let scores: Vec<Score> = compared.iter().map(|(_, found)| found.score).collect();
    let mean = Score::mean(&scores);
    if arguments.json {
        let mut pictures: Vec<Value> = compared.iter().map(|(_, found)| json_of(found)).collect();
        for (value, (name, _)) in pictures.iter_mut().zip(&compared) {
            value["name"] = json!(name);
        }
        let found = json!({
            "pictures": pictures, "mean": mean, "left_out": left_out, "lpips_weights": perceptual::describe(lpips),
        });
        say::json(&found.to_string())?;
    } else {
        let plain = |value: Option<f64>| value.map_or("n/a".into(), |v| format!("{v:.4}"));
        let line = |name: &str, Score { psnr, ssim, lpips }: &Score| {
            let (ssim, lpips) = (plain(*ssim), plain(*lpips));
            format!("{name:<24} PSNR {psnr:.3} dB   SSIM {ssim}   LPIPS {lpips}")
        };
        let mut lines: Vec<String> = compared.iter().map(|(name, found)| line(name, &found.score)).collect();
        lines.extend(mean.map(|mean| line(&format!("mean of {}", compared.len()), &mean)));
        lines.push(format!("LPIPS: {}", perceptual::describe(lpips)));
        say::lines(&lines.join("\n"))?;
        print_left_out(&left_out);
    }
    match (compared.len(), left_out.len()) {
        (0, 0) => Err(Failure::Input(format!("{} and {}: contain no picture", a.display(), b.display()))),
        (_, 0) => Ok(()),
        (n, lost) => Err(Failure::Internal(format!("{n} pictures compared, {lost} left out"))),
    }
}

/// Names of the pictures of a folder.
fn pictures_in(folder: &Path) -> Result<BTreeSet<String>, Failure> {
    let name = |path: PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    Ok(pictures(folder)?.map(name).collect())
}

fn compare(
    arguments: &Arguments,
    a: &Path,
    b: &Path,
    mask: Option<&Path>,
    lpips: &Result<Lpips, String>,
) -> Result<Compared, Failure> {
    let read = |path: &Path| -> Result<Picture, Failure> {
        let [width, height] = picture::size(path, None)?;
        let bytes = BYTES * u64::from(width) * u64::from(height);
        memory::check(&format!("{}, {width}×{height},", path.display()), bytes, "make the pictures smaller")?;
        let named = |e| Failure::file(path, e);
        Picture::from_file(decode(path, MAX_BYTES)?, "picture").map_err(named)
    };
    let (image, target) = (read(a)?, read(b)?);
    let named = |e| Failure::Input(format!("{} and {}: {e}", a.display(), b.display()));
    check_sizes(&image, &target).map_err(named)?;
    let region = match (arguments.window, mask) {
        (_, Some(path)) => {
            let mask = decode(path, MAX_BYTES)?;
            let found = [mask.height() as usize, mask.width() as usize];
            if found != [target.height, target.width] {
                let ([h, w], Picture { height, width, .. }) = (found, &target);
                let message = format!("is {w}×{h}, the pictures are {width}×{height}");
                return Err(Failure::file(path, message));
            }
            let mask: Vec<f32> = mask.into_luma16().pixels().map(|p| f32::from(p.0[0])).collect();
            let margin = arguments.margin.unwrap_or_else(|| margin(target.height));
            Region::masked(&mask, found, margin).map_err(|e| Failure::file(path, e))?
        }
        (Some(Window::Paper), _) => Region::paper(&target).map_err(|e| Failure::file(b, e))?,
        _ => Region::all(&target),
    };
    Ok(Compared {
        score: Score::new(&image, &target, &region, lpips.as_ref().ok()).map_err(named)?,
        ssim_gaussian: ssim_of_loss(&image, &target, &region).map_err(named)?,
        region,
    })
}

fn json_of(compared: &Compared) -> Value {
    let mut value = json!(compared.score);
    value["ssim_gaussian"] = json!(compared.ssim_gaussian);
    value["window"] = json!(compared.region.window);
    value["pixels"] = json!(compared.region.pixels());
    value
}

fn text_of(compared: &Compared, lpips: &Result<Lpips, String>) -> String {
    let [x, y, width, height] = compared.region.window;
    let plain = |value: Option<f64>, why: &str| value.map_or(format!("n/a ({why})"), |v| format!("{v:.6}"));
    let why = lpips.as_ref().err().map_or("the window is too small", String::as_str);
    [
        format!("PSNR           {:.4} dB", compared.score.psnr),
        format!("SSIM           {} (uniform window)", plain(compared.score.ssim, "the window is too small")),
        format!("SSIM of loss   {:.6} (Gaussian window)", compared.ssim_gaussian),
        format!("LPIPS          {}{}", plain(compared.score.lpips, why), perceptual::mark(lpips)),
        format!("window         {width}×{height} at {x}, {y}; {} pixels", compared.region.pixels()),
    ]
    .join("\n")
}
