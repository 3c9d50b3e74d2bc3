//! Every format that the program reads: the command that reads it, and the files that are changed.

/// Cases of a seed for each kind of file.
const CASES: u32 = 10;

/// Something that the program reads.
pub struct Format {
    pub name: &'static str,
    /// Command line that reads a sound sample. [`super::samples`] makes what is in the folder `in`.
    pub command: String,
    /// Kinds of files that are changed: endings of their paths.
    pub changed: Vec<&'static str>,
    /// Files and folders that may be left though the input is refused.
    pub kept: &'static [&'static str],
    /// Cases of a seed.
    pub cases: u32,
}

impl Format {
    /// The file that the command writes, if it is one: a file of that name may be there already.
    pub fn output(&self) -> Option<&str> {
        self.command.split_whitespace().find(|word| word.starts_with("out."))
    }

    /// Whether the command does what it can without the parts that it cannot read, names them, and ends with code 1.
    pub fn is_partial(&self) -> bool {
        self.command.starts_with("evaluate") || self.command.starts_with("bench")
    }

    fn cases(self, cases: u32) -> Self {
        Self { cases, ..self }
    }
}

/// `changed` are the endings of [`Format::changed`], with spaces between them.
fn format(name: &'static str, changed: &'static str, command: &str) -> Format {
    let (command, changed) = (command.to_owned(), changed.split(' ').collect::<Vec<_>>());
    let cases = CASES * changed.len() as u32;
    Format { name, command, changed, kept: &[], cases }
}

fn reconstruct(name: &'static str, changed: &'static str, arguments: &str) -> Format {
    let model = "--weights in/w.safetensors --device cpu";
    format(name, changed, &format!("reconstruct {arguments} {model} -v -o out.ply"))
}

fn render(name: &'static str, file: &'static str) -> Format {
    let options = "--orbit 2 --size 16x24 --device cpu -o out --raw out.safetensors";
    format(name, file, &format!("render in/{file} {options}"))
}

fn import(name: &'static str, changed: &'static str, arguments: &str) -> Format {
    format(name, changed, &format!("import-weights {arguments} -o out.safetensors"))
}

fn prepare(name: &'static str, changed: &'static str, arguments: &str) -> Format {
    let small = "--set views.count=2 --set views.resolution=16 --set views.samples_per_axis=1";
    let format = format(name, changed, &format!("prepare {arguments} -o out {small}"));
    Format { kept: &["out/dataset.toml", "out/prepare.config.toml"], ..format }
}

/// A rehearsal, which writes nothing. Settings that could make it slow are fixed.
fn rehearse(name: &'static str, arguments: &str) -> Format {
    let small = "--set network.enc_depth=1 --set network.dec_depth=2 --set network.enc_dim=16 \
                 --set network.dec_dim=16 --set network.layer_dims=[4,4,8,8] --set network.hooks=[0,1,1,2] \
                 --set network.feature_dim=8 --set network.last_dim=4 --set training.batch=1 \
                 --set training.workers=1 --set training.validation_samples=1 --set samples.random_targets=1";
    let command = format!("{arguments} --config in/t.toml --device cpu --dry-run {small}");
    format(name, "t.toml", &command)
}

/// All formats.
pub fn all() -> Vec<Format> {
    let masked = "in/a.jpg in/progressive.jpg --masks in/m.png in/m.jpg";
    let model = "--weights in/w.safetensors --device cpu -o out";
    let evaluate = "evaluate --config in/e.toml --data in/people";
    let meshes = "--mesh-dir in/scans --align similarity --set data.scans=in/scans -o out";
    let bench = "bench --config in/b.toml --data in/people --set bench.resolution=32 --quick";
    let evaluated = "e.toml dataset.toml a/1.png a/2.png test/depth/a/1.npz test/cameras/a.json";
    let body = "base.obj .mhskel .mhw .target .mhclo worn.obj .bvh";
    vec![
        reconstruct("pictures", "a.png b.webp", "in/a.png in/b.webp"),
        reconstruct("pictures-deep", "deep.png b.gif", "in/deep.png in/b.gif --as-is"),
        reconstruct("pictures-plain", "a.tiff b.bmp", "in/a.tiff in/b.bmp"),
        reconstruct("pictures-and-masks", "a.jpg progressive.jpg m.png m.jpg", masked),
        reconstruct("picture-heic", "heic.jpg", "in/heic.jpg in/a.jpg --masks in/m.png in/m.jpg"),
        reconstruct("weights", "w.safetensors n.toml", "in/a.png in/b.webp --as-is --config in/n.toml"),
        format("weights-export", "w.safetensors", "export-weights in/w.safetensors -o out.safetensors"),
        import("weights-import", "w.safetensors n.toml", "in/w.safetensors --config in/n.toml"),
        import("checkpoint", "stage1.pth stage2.pth", "in/stage1.pth in/stage2.pth --config in/tiny.toml"),
        render("gaussians", "h.ply"),
        render("gaussians-ascii", "ascii.ply"),
        render("gaussians-big-endian", "big_endian.ply"),
        render("gaussians-glb", "h.glb"),
        render("spz", "h.spz"),
        // With spherical harmonics, from another implementation.
        format("spz-harmonics", "v3_degree3.spz", "convert in/v3_degree3.spz out.ply"),
        format("spz-streams", "v4_degree3.spz4", "convert in/v4_degree3.spz4 out.ply"),
        format("sog", "cloud.sog", "convert in/cloud.sog out.ply"),
        format("gaussians-compressed", "cloud.compressed.ply", "convert in/cloud.compressed.ply out.ply"),
        format("splat", "h.splat", "convert in/h.splat out.ply"),
        // A mesh takes seconds, hence few cases.
        format("gaussians-mesh", "rod.ply", "mesh in/rod.ply --faces 500 --device cpu -o out.ply").cases(1),
        format("cameras", "cameras.json", "render in/h.ply --cameras in/cameras.json --device cpu -o out"),
        format(
            "cameras-of-splatting",
            "splatting.json",
            "render in/h.ply --cameras in/splatting.json --device cpu -o out",
        ),
        format(
            "cameras-of-fields",
            "transforms.json",
            "render in/h.ply --cameras in/transforms.json --device cpu -o out",
        ),
        prepare("obj", ".obj .mtl .png .tiff", "scan in/a.obj"),
        prepare("mesh-ply", "mesh.ply", "scan in/mesh.ply"),
        prepare("mesh-ply-big-endian", "mesh_big_endian.ply", "scan in/mesh_big_endian.ply"),
        prepare("mesh-ply-ascii", "mesh_ascii.ply", "scan in/mesh_ascii.ply"),
        prepare("glb", "a.glb", "scan in/a.glb").cases(40),
        prepare("glb-odd", "odd.glb", "scan in/odd.glb").cases(40),
        // The first character is for test.
        prepare("avatars", "b_suit.glb", "avatars in/avatars --subjects 1"),
        // The people whose files are sound are made.
        Format { kept: &["out"], ..prepare("smplx", ".pkl", "scan in/scans --smplx in/scans") }.cases(40),
        prepare("config-data", "training.toml", "scan in/a.obj --config in/training.toml"),
        // The person of seed 2 wears a suit, shoes and hair.
        prepare("makehuman", body, "makehuman in/makehuman --subjects 1 --seed 2"),
        format("data-set", "dataset.toml .png .npz .json", "prepare check in/set"),
        format("data-set-authors", "dataset.toml .jpg .png .npy", "prepare check in/set_32_2"),
        rehearse("train-config", "train-stage1"),
        rehearse("train-config-stage2", "train-stage2 --weights in/w.safetensors"),
        format("evaluation", evaluated, &format!("{evaluate} {model}")).cases(20),
        format("evaluation-mesh", "a.obj", &format!("{evaluate} {meshes}")),
        format("bench-config", "b.toml", &format!("{bench} {model}")),
        format("compare", "a.png float.tiff m.png", "compare in/a.png in/float.tiff --mask in/m.png --json"),
    ]
}
