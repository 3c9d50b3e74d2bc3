//! Every format that the program reads: a small sound sample, and the command that reads it.

use std::path::Path;

use super::{checks, samples as s};

/// Whether the output in this folder is whole; else the fault.
type Check = fn(&Path) -> Result<(), String>;

/// Something that the program reads.
pub struct Format {
    pub name: &'static str,
    /// Writes a sound sample into this empty folder, the smaller the better.
    pub sample: fn(&Path),
    /// Command line that reads the sample; the sample is in the folder `in`.
    pub command: String,
    /// Endings of the paths of the sample's files that are changed.
    pub changed: Vec<&'static str>,
    /// The file that the command writes, if it is one: a file of that name may be there already.
    pub file: Option<&'static str>,
    pub is_whole: Check,
    /// Whether the command does what it can without the parts that it cannot read, names them, and ends with code 1.
    pub is_partial: bool,
    /// Files and folders that may be left though the input is refused.
    pub kept: &'static [&'static str],
    /// Cases of a seed.
    pub share: u32,
}

/// `changed` are the endings of [`Format::changed`], with spaces between them.
fn format(name: &'static str, sample: fn(&Path), changed: &'static str, command: &str) -> Format {
    let (command, changed) = (command.to_owned(), changed.split(' ').collect());
    let is_whole = |_: &Path| Ok(());
    Format { name, sample, command, changed, file: None, is_whole, is_partial: false, kept: &[], share: 14 }
}

fn reconstruct(name: &'static str, sample: fn(&Path), changed: &'static str, arguments: &str) -> Format {
    let command = format!("reconstruct {arguments} --weights in/w.safetensors --device cpu -v -o out.ply");
    format(name, sample, changed, &command).writes("out.ply", checks::person)
}

fn render(name: &'static str, sample: fn(&Path), file: &'static str) -> Format {
    let command =
        format!("render in/{file} --orbit 2 --size 16x24 --device cpu -o out --raw out.safetensors");
    format(name, sample, file, &command).writes("out.safetensors", checks::rendered)
}

fn prepare(name: &'static str, sample: fn(&Path), changed: &'static str, arguments: &str) -> Format {
    let small = "--set views.count=2 --set views.resolution=16 --set views.samples_per_axis=1";
    let format = format(name, sample, changed, &format!("prepare {arguments} -o out {small}"));
    Format { kept: &["out/dataset.toml", "out/prepare.config.toml"], is_whole: checks::data_set, ..format }
}

/// A rehearsal, which writes nothing. Settings that could make it slow are fixed.
fn rehearsal(name: &'static str, arguments: &str) -> Format {
    let small = [
        "network.enc_depth=1",
        "network.dec_depth=2",
        "network.enc_dim=16",
        "network.dec_dim=16",
        "network.layer_dims=[4,4,8,8]",
        "network.hooks=[0,1,1,2]",
        "network.feature_dim=8",
        "network.last_dim=4",
        "training.batch=1",
        "training.workers=1",
        "training.validation_samples=1",
        "samples.random_targets=1",
    ];
    let small: String = small.iter().map(|key| format!(" --set {key}")).collect();
    let command = format!("{arguments} --config in/t.toml --device cpu --dry-run{small}");
    format(name, s::training, "t.toml", &command).share(10)
}

fn report(name: &'static str, changed: &'static str, command: &str, is_whole: Check) -> Format {
    let format = format(name, s::evaluation, changed, &format!("{command} -o out"));
    Format { is_partial: true, is_whole, share: 8, ..format }
}

impl Format {
    fn writes(self, file: &'static str, is_whole: Check) -> Self {
        Self { file: Some(file), is_whole, ..self }
    }

    fn checked(self, is_whole: Check) -> Self {
        Self { is_whole, ..self }
    }

    fn share(self, share: u32) -> Self {
        Self { share, ..self }
    }
}

/// All formats.
pub fn all() -> Vec<Format> {
    let masked = "in/a.jpg in/b.jpg --masks in/m.png in/m.jpg";
    let trained = "--weights in/w.safetensors";
    // Of training people, only pictures are read.
    let evaluated = "e.toml dataset.toml 0000/1.png 0000/2.png test/depth/0000/1.npz test/cameras/0000.json";
    let tensors = "out.safetensors";
    vec![
        reconstruct("pictures", s::png_and_webp, "a.png b.webp", "in/a.png in/b.webp").share(28),
        reconstruct("pictures-deep", s::deep_and_gif, "a.png b.gif", "in/a.png in/b.gif --as-is").share(28),
        reconstruct("pictures-plain", s::tiff_and_bmp, "a.tiff b.bmp", "in/a.tiff in/b.bmp").share(28),
        reconstruct("pictures-and-masks", s::jpegs_and_masks, "a.jpg b.jpg m.png m.jpg", masked).share(42),
        // The first bytes of a picture say what it is, not its name.
        reconstruct("picture-heic", s::heic_and_masks, "a.jpg", masked),
        reconstruct(
            "weights",
            s::png_and_webp,
            "w.safetensors c.toml",
            "in/a.png in/b.webp --as-is --config in/c.toml",
        )
        .share(28),
        format(
            "weights-export",
            s::weights,
            "w.safetensors",
            "export-weights in/w.safetensors -o out.safetensors",
        )
        .writes(tensors, checks::tensors),
        format(
            "weights-import",
            s::weights,
            "w.safetensors c.toml",
            "import-weights in/w.safetensors --config in/c.toml -o out.safetensors",
        )
        .writes(tensors, checks::weight_file)
        .share(28),
        format(
            "checkpoint",
            s::checkpoints,
            "stage1.pth stage2.pth",
            "import-weights in/stage1.pth in/stage2.pth --config in/c.toml -o out.safetensors",
        )
        .writes(tensors, checks::weight_file),
        render("gaussians", |folder| s::gaussians(folder, "h.ply"), "h.ply"),
        render("gaussians-ascii", s::gaussians_ascii, "h.ply"),
        render("gaussians-big-endian", s::gaussians_big_endian, "h.ply"),
        render("gaussians-glb", |folder| s::gaussians(folder, "h.glb"), "h.glb"),
        render("spz", |folder| s::gaussians(folder, "h.spz"), "h.spz"),
        // With spherical harmonics, from another implementation.
        format("spz-harmonics", s::spz_harmonics, "h.spz", "convert in/h.spz out.ply")
            .writes("out.ply", checks::scene),
        // A mesh takes seconds, hence few cases.
        format("gaussians-mesh", s::column, "h.ply", "mesh in/h.ply --faces 500 --device cpu -o out.ply")
            .writes("out.ply", checks::mesh)
            .share(1),
        format(
            "cameras",
            s::cameras,
            "cameras.json",
            "render in/h.ply --cameras in/cameras.json --device cpu -o out",
        )
        .checked(checks::rendered_by_cameras),
        prepare("obj", s::obj_and_textures, ".obj .mtl .png .tiff", "scan in/a.obj").share(48),
        prepare("mesh-ply", |folder| s::ply(folder, "binary_little_endian"), ".ply", "scan in/a.ply"),
        prepare("mesh-ply-big-endian", |folder| s::ply(folder, "binary_big_endian"), ".ply", "scan in/a.ply"),
        prepare("mesh-ply-ascii", |folder| s::ply(folder, "ascii"), ".ply", "scan in/a.ply"),
        prepare("glb", s::glb, "a.glb", "scan in/a.glb").share(48),
        prepare("avatars", s::avatars, "b_suit.glb", "avatars in --subjects 1"),
        // The people whose files are sound are made.
        Format { kept: &["out"], ..prepare("smplx", s::smplx, ".pkl .json", "scan in --smplx in/smplx") }
            .share(42),
        prepare("config-data", s::data_config, "c.toml", "scan in/a.obj --config in/c.toml"),
        prepare(
            "makehuman",
            s::makehuman,
            "base.obj .mhskel .mhw .target .mhclo worn.obj .bvh",
            "makehuman in --subjects 1 --seed 2",
        ),
        format("data-set", s::exact_set, "dataset.toml .png .npz .json", "prepare check in/set").share(28),
        format(
            "data-set-authors",
            s::authors_set,
            "dataset.toml .jpg .png .npy",
            "prepare check in/set_16_2",
        )
        .share(28),
        format("data-set-packed", s::packed_set, "dataset.toml archives.csv .tar", "prepare check in/packed")
            .share(28),
        rehearsal("train-config", "train-stage1"),
        rehearsal("train-config-stage2", &format!("train-stage2 {trained}")),
        report(
            "evaluation",
            evaluated,
            &format!("evaluate --config in/e.toml {trained} --device cpu"),
            |folder| checks::report(folder, "protocols"),
        )
        .share(16),
        report(
            "evaluation-mesh",
            "0000.obj",
            "evaluate --config in/e.toml --mesh-dir in/scans --align similarity",
            |folder| checks::report(folder, "geometry_cm"),
        ),
        report(
            "bench-config",
            "b.toml",
            &format!("bench --config in/b.toml --quick {trained} --device cpu"),
            |folder| checks::report(folder, "settings"),
        ),
        format(
            "compare",
            s::compared,
            "a.png b.tiff m.png",
            "compare in/a.png in/b.tiff --mask in/m.png --window mask --json",
        )
        .share(8),
    ]
}
