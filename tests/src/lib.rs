//! Helpers of the parity and end-to-end tests: devices, fixtures, error norms.

// These modules use interfaces of Linux.
#[cfg(target_os = "linux")]
pub mod browser;
pub mod character;
pub mod ply;
pub mod sample;
pub mod scenes;
pub mod server;
pub mod workplace;

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

use burn::tensor::{Device, DeviceKind, DeviceType, Tensor, TensorData};
use safetensors::{Dtype, SafeTensors};

/// A short training of small networks.
pub const TRAINING: &str = concat!(
    include_str!("../../crates/train/src/stability/small.toml"),
    r#"
[training]
steps = 40
batch = 2
ema_decay = 0.9
log_every = 1
validate_every = 10
validation_samples = 2
checkpoint_every = 4
preview_every = 20
[optimizer]
rate = 1e-2
[optimizer.muon]
rate = 1e-2
[schedule]
kind = "cosine"
warm_up = 2
[stage2]
alpha_weight = 0.5
"#
);

/// Name of the device that tests run on: `SNAPSNAP_TEST_DEVICE` = `flex` (default), `ndarray`, `wgpu`, or, if compiled
/// in, `vulkan`.
pub fn device_name() -> String {
    std::env::var("SNAPSNAP_TEST_DEVICE").unwrap_or_else(|_| "flex".into())
}

/// Whether tests run on a GPU's kernels.
pub fn is_on_gpu() -> bool {
    matches!(device_name().as_str(), "wgpu" | "vulkan")
}

/// The device that tests run on, or `None`, with a printed note, if the machine has no adapter for it.
///
/// `wgpu` takes any adapter, also a software one. `cargo xtask test` runs the suite on each device.
pub fn device() -> Option<Device> {
    match device_name().as_str() {
        "flex" => Some(Device::flex()),
        "ndarray" => Some(ndarray()),
        "wgpu" => adapter(DeviceType::Wgpu).then(|| Device::wgpu(DeviceKind::DefaultDevice)),
        #[cfg(feature = "vulkan")]
        "vulkan" => adapter(DeviceType::Vulkan).then(|| Device::vulkan(DeviceKind::DefaultDevice)),
        other => {
            panic!(
                "SNAPSNAP_TEST_DEVICE = {other}: allowed are flex, ndarray, wgpu, and vulkan if compiled in"
            )
        }
    }
}

/// Whether there is an adapter. A missing one is an error if `SNAPSNAP_REQUIRE_WGPU` is set.
fn adapter(kind: DeviceType) -> bool {
    let is_wgpu = matches!(kind, DeviceType::Wgpu);
    let found = std::panic::catch_unwind(|| {
        let unused = is_wgpu && snapsnap_splat::graphics_api::is_opengl();
        !(unused || Device::enumerate(kind).into_vec().is_empty())
    });
    let found = found.unwrap_or(false);
    if !found {
        let name = device_name();
        assert!(
            std::env::var_os("SNAPSNAP_REQUIRE_WGPU").is_none(),
            "no {name} adapter, but one is required"
        );
        println!("SKIPPED: no {name} adapter on this machine");
    }
    found
}

/// [`device`], unless it is a software GPU, which compiles kernels for minutes.
pub fn real_device() -> Option<Device> {
    let device = device()?;
    if is_software(&device) {
        println!("SKIPPED: on a software adapter this takes minutes");
        return None;
    }
    Some(device)
}

/// Whether a device is a software GPU, on which kernels are slow.
pub fn is_software(device: &Device) -> bool {
    device.identity().is_some_and(|identity| identity.physical.is_none())
}

#[allow(deprecated, reason = "the second CPU implementation")]
fn ndarray() -> Device {
    Device::ndarray()
}

/// Builds a part of the workspace with the features of the tests' own build and with `features`. Returns the folder
/// of the built files.
pub fn build(part: &[&str], features: &str) -> PathBuf {
    let test = std::env::current_exe().expect("the test's own path");
    let release = test.ancestors().nth(2).expect("target/release/deps/test");
    let target = release.parent().expect("target/release");
    let cargo = std::env::var_os("CARGO").unwrap_or_else(|| "cargo".into());
    let mut build = Command::new(cargo);
    build.args(["build", "--quiet", "--release"]).args(part).arg("--target-dir").arg(target);
    let own = std::env::var("SNAPSNAP_FEATURES").unwrap_or_default();
    build.args(["--features", &format!("{own},{features}")]).current_dir(root());
    assert!(build.status().expect("cargo starts").success(), "{part:?} builds");
    release.to_owned()
}

/// The program as a user starts it. It is built first, unless `SNAPSNAP_PROGRAM` is the path of a program.
pub fn snapsnap() -> Command {
    static PROGRAM: OnceLock<PathBuf> = OnceLock::new();
    let program = PROGRAM.get_or_init(|| {
        if let Some(program) = std::env::var_os("SNAPSNAP_PROGRAM") {
            return program.into();
        }
        let release = build(&["--package", "snapsnap", "--bin", "snapsnap"], "");
        release.join("snapsnap").with_extension(std::env::consts::EXE_EXTENSION)
    });
    let mut command = Command::new(program);
    command.env_remove("RUST_BACKTRACE");
    command
}

/// A command that makes a split of a data set of synthetic people, with pictures of 64² pixels.
pub fn synthetic_people(folder: &Path, split: &str, people: usize, views: usize) -> Command {
    let (people, views) = (people.to_string(), format!("views.count={views}"));
    let mut command = snapsnap();
    command.args(["prepare", "synth", "--seed", "5", "--subjects", &people, "--split", split]);
    command.args(["--set", &views, "--set", "views.resolution=64", "-o"]).arg(folder);
    command
}

/// Sets every value of a weight file in f32.
pub fn fill_weights(path: &Path, value: f32) {
    let mut file = fs::read(path).expect("reads");
    let header = 8 + u64::from_le_bytes(file[..8].try_into().expect("eight bytes")) as usize;
    file[header..].chunks_exact_mut(4).for_each(|bytes| bytes.copy_from_slice(&value.to_le_bytes()));
    fs::write(path, file).expect("writes");
}

/// Sets the first values of a tensor of a weight file in f32.
pub fn set_tensor(path: &Path, name: &str, values: &[f32]) {
    let mut file = fs::read(path).expect("reads");
    let parsed = SafeTensors::deserialize(&file).expect("a safetensors file");
    let start = parsed.tensor(name).expect("the tensor").data().as_ptr() as usize - file.as_ptr() as usize;
    let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
    file[start..start + bytes.len()].copy_from_slice(&bytes);
    fs::write(path, file).expect("writes");
}

/// Runs a command that must succeed. Returns its output.
pub fn succeed(command: &mut Command) -> String {
    let output = command.output().expect("the program starts");
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{command:?}: {}\n{out}\n{err}", output.status);
    out.into_owned()
}

/// Runs a command that must end without a panic. Returns its exit code and its messages on stderr.
pub fn ended(command: &mut Command) -> (Option<i32>, String) {
    let output = command.output().expect("the program starts");
    let err = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!err.contains("panicked"), "{err}");
    (output.status.code(), err)
}

/// Runs a command that must end with this exit code. Returns its messages on stderr.
pub fn ended_with(code: i32, command: &mut Command) -> String {
    let (found, err) = ended(command);
    assert_eq!(found, Some(code), "{command:?}: {err}");
    err
}

/// Runs a command that must refuse its input with exit code 2. Returns its message.
pub fn refused(command: &mut Command) -> String {
    ended_with(2, command)
}

/// Asserts that a message has all of these parts.
pub fn assert_says(message: &str, parts: &[&str]) {
    for part in parts {
        assert!(message.contains(part), "{part}: {message}");
    }
}

/// The command under a limit of `ulimit`: `-v` kilobytes of memory, or files of `-f` blocks, which imitate a full disk.
pub fn limited(command: &Command, limit: &str) -> Command {
    let mut shell = Command::new("sh");
    // The shell ignores the signal of a file that is too long, so that the program gets an error.
    shell.arg("-c").arg(format!("trap '' XFSZ; ulimit {limit}; exec \"$@\"")).arg("sh");
    shell.arg(command.get_program()).args(command.get_args());
    if let Some(folder) = command.get_current_dir() {
        shell.current_dir(folder);
    }
    shell
}

/// Every regular file below a folder: its path from there, and its content.
pub fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in fs::read_dir(folder).expect("lists").map(|entry| entry.expect("an entry")) {
        let (path, name) = (entry.path(), PathBuf::from(entry.file_name()));
        if path.is_dir() {
            found.extend(files(&path).into_iter().map(|(below, content)| (name.join(below), content)));
        } else if path.is_file() {
            found.insert(name, fs::read(path).expect("reads"));
        }
    }
    found
}

/// Names of the entries of a folder, in their order.
pub fn names(folder: &Path) -> Vec<String> {
    let entries = fs::read_dir(folder).expect("lists").map(|entry| entry.expect("an entry").file_name());
    let mut names: Vec<String> = entries.map(|name| name.into_string().expect("UTF-8")).collect();
    names.sort();
    names
}

/// Copies a folder with everything below it.
pub fn copy_folder(from: &Path, to: &Path) {
    fs::create_dir_all(to).expect("makes");
    for (name, content) in files(from) {
        let target = to.join(name);
        fs::create_dir_all(target.parent().expect("a folder")).expect("makes");
        fs::write(target, content).expect("writes");
    }
}

/// The repository, or the folder `SNAPSNAP_ROOT` with its `configs` and `tests/data`.
pub fn root() -> PathBuf {
    let built = || Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace root").to_owned();
    std::env::var_os("SNAPSNAP_ROOT").map_or_else(built, PathBuf::from)
}

/// Test data of this repository.
pub fn data(name: &str) -> PathBuf {
    root().join("tests/data").join(name)
}

/// A file or folder of reference numbers (tests/data/README.md); `SNAPSNAP_FIXTURES` names another folder that has
/// them.
///
/// # Panics
/// If it is missing.
pub fn fixture(name: &str) -> PathBuf {
    let folder = std::env::var_os("SNAPSNAP_FIXTURES").map_or_else(|| data(""), PathBuf::from);
    let path = folder.join(name);
    assert!(path.exists(), "{}: a reference fixture is missing", path.display());
    path
}

/// How many values of each tensor the repository's fixtures of gradients and trained weights have at least, if the
/// tensor has as many: they are cut to their first values.
pub const FIXTURE_VALUES: usize = 512;

/// Relative L2 error of `got` where `expected` has values: the first ones of a tensor, or all.
///
/// # Panics
/// If `expected` has fewer than [`FIXTURE_VALUES`] values and `got` more.
pub fn start_error(got: &[f32], expected: &[f32]) -> f64 {
    assert!(expected.len() >= got.len().min(FIXTURE_VALUES), "{} of {} values", expected.len(), got.len());
    relative_error(&got[..expected.len()], expected)
}

/// The TOML config of a fixture's `config.json`, with every quirk.
pub fn toml_config(json: &Path) -> String {
    let text = fs::read_to_string(json).expect("config.json");
    let json: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    let same = [
        "enc_dim",
        "enc_depth",
        "enc_heads",
        "dec_dim",
        "dec_depth",
        "dec_heads",
        "layer_dims",
        "feature_dim",
        "last_dim",
        "hooks",
        "head",
        "resolution",
        "net_resolution",
        "conf_threshold",
    ];
    let there = same.iter().filter(|key| !json[**key].is_null());
    let mut lines: Vec<String> = there.map(|key| format!("{key} = {}", json[*key])).collect();
    lines.push(format!("conf_mode = {}", json["conf_mode"][0]));
    format!("[network]\n{}\n[mode]\ncompat = true\n", lines.join("\n"))
}

/// A folder beside the checkout.
pub fn shared(name: &str) -> PathBuf {
    root().join("../shared").join(name)
}

/// A folder beside the checkout, or `None`, with a printed note, if it is not there.
pub fn shared_folder(name: &str) -> Option<PathBuf> {
    let folder = shared(name);
    if !folder.is_dir() {
        println!("SKIPPED: {} is not there", folder.display());
        return None;
    }
    Some(folder)
}

/// A `.safetensors` file in memory.
pub struct Numbers(Vec<u8>);

impl Numbers {
    /// Reads the file.
    pub fn read(path: &Path) -> Self {
        Self(fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display())))
    }

    /// Names of all tensors.
    pub fn names(&self) -> Vec<String> {
        self.file().names().into_iter().map(str::to_owned).collect()
    }

    /// Whether there is a tensor of this name.
    pub fn has(&self, name: &str) -> bool {
        self.file().tensor(name).is_ok()
    }

    /// Shape and values of an f32 tensor.
    pub fn f32(&self, name: &str) -> (Vec<usize>, Vec<f32>) {
        let (shape, bytes) = self.bytes(name, Dtype::F32);
        (shape, bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect())
    }

    /// Shape and values of an f64 tensor.
    pub fn f64(&self, name: &str) -> (Vec<usize>, Vec<f64>) {
        let (shape, bytes) = self.bytes(name, Dtype::F64);
        (shape, bytes.as_chunks::<8>().0.iter().map(|b| f64::from_le_bytes(*b)).collect())
    }

    /// The value of `key` in the file's metadata.
    pub fn metadata(&self, key: &str) -> String {
        let (_, metadata) = SafeTensors::read_metadata(&self.0).expect("a safetensors file");
        metadata.metadata().as_ref().and_then(|m| m.get(key).cloned()).unwrap_or_else(|| panic!("no {key}"))
    }

    /// Shape and values of a u8 tensor.
    pub fn u8(&self, name: &str) -> (Vec<usize>, Vec<u8>) {
        self.bytes(name, Dtype::U8)
    }

    fn bytes(&self, name: &str, kind: Dtype) -> (Vec<usize>, Vec<u8>) {
        let file = self.file();
        let view = file.tensor(name).unwrap_or_else(|e| panic!("{name}: {e}"));
        assert_eq!(view.dtype(), kind, "{name}");
        (view.shape().to_vec(), view.data().to_vec())
    }

    /// An f32 tensor on a device.
    pub fn tensor<const D: usize>(&self, name: &str, device: &Device) -> Tensor<D> {
        let (shape, values) = self.f32(name);
        Tensor::from_data(TensorData::new(values, shape), device)
    }

    fn file(&self) -> SafeTensors<'_> {
        SafeTensors::deserialize(&self.0).expect("a safetensors file")
    }
}

/// ‖got − expected‖₂ / ‖expected‖₂, in f64.
pub fn relative_error(got: &[f32], expected: &[f32]) -> f64 {
    assert_eq!(got.len(), expected.len(), "number of values");
    let square = |x: f64| x * x;
    let difference: f64 = got.iter().zip(expected).map(|(a, b)| square(f64::from(*a) - f64::from(*b))).sum();
    let norm: f64 = expected.iter().map(|b| square(f64::from(*b))).sum();
    (difference / norm.max(f64::MIN_POSITIVE)).sqrt()
}

/// Values of a tensor on the host.
pub fn values<const D: usize>(tensor: Tensor<D>) -> Vec<f32> {
    tensor.into_data().try_into_vec().expect("an f32 tensor")
}

/// Asserts a relative L2 error, and prints it for the log.
pub fn assert_close<const D: usize>(
    what: &str,
    got: Tensor<D>,
    expected: &(Vec<usize>, Vec<f32>),
    bound: f64,
) {
    assert_eq!(got.dims().as_slice(), expected.0.as_slice(), "{what}: shape");
    let error = relative_error(&values(got), &expected.1);
    println!("{what}: relative error {error:.2e}");
    assert!(error <= bound, "{what}: relative error {error:.3e} > {bound:.0e}");
}

/// EXIF data of a phone: the focal length in mm on 35 mm film, and Apple's maker note with the acceleration in
/// thousandths of gravity.
pub fn exif(focal: u16, acceleration: [i32; 3]) -> Vec<u8> {
    let entry = |tag: u16, kind: u16, count: u32, value: [u8; 4]| {
        [&tag.to_be_bytes()[..], &kind.to_be_bytes(), &count.to_be_bytes(), &value].concat()
    };
    let mut note = b"Apple iOS\0\0\x01MM\0\x01".to_vec();
    note.extend(entry(8, 10, 3, 32_u32.to_be_bytes()));
    note.extend([0; 4]);
    acceleration.iter().for_each(|value| note.extend([value.to_be_bytes(), 1000_i32.to_be_bytes()].concat()));
    let [high, low] = focal.to_be_bytes();
    let mut tiff = b"MM\0\x2a\0\0\0\x08\0\x01".to_vec();
    tiff.extend(entry(0x8769, 4, 1, 26_u32.to_be_bytes()));
    tiff.extend([0; 4]);
    tiff.extend(2_u16.to_be_bytes());
    tiff.extend(entry(0x927c, 7, note.len() as u32, 56_u32.to_be_bytes()));
    tiff.extend(entry(0xa405, 3, 1, [high, low, 0, 0]));
    tiff.extend([0; 4]);
    [tiff, note].concat()
}
