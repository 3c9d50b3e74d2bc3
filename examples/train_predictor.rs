//! A point predictor is trained from scratch: synthetic people, a data set of their views, samples, the losses of stage 1,
//! an optimiser, a weight file.
//!
//! ```sh
//! cargo run --release --example train_predictor           # 400 steps, less than a minute on two cores
//! cargo run --release --example train_predictor -- 40 predictor.safetensors
//! ```
//!
//! `snapsnap train-stage1` does the same for larger networks, with checkpoints, validations and logs.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use burn::module::Module;
use burn::tensor::Device;
use snapsnap_base::FileError;
use snapsnap_base::config::Schema;
use snapsnap_data::dataset::{Folder, Split};
use snapsnap_data::prepare::DataConfig;
use snapsnap_data::sample::{Augment, SampleConfig, Stage1, Stage1Batch, Stage1Item};
use snapsnap_net::config::Config;
use snapsnap_net::network::View;
use snapsnap_net::steps::Record;
use snapsnap_net::weights::{random_predictor, save};
use snapsnap_net::{Prediction, Window};
use snapsnap_people::{Detail, synth};
use snapsnap_train::gradients;
use snapsnap_train::networks::Networks;
use snapsnap_train::optimizer::{MuonSettings, OptimizerConfig};
use snapsnap_train::points::losses;
use snapsnap_train::schedule::Schedule;
use snapsnap_train::task::Part;

/// A small convolutional body on a canvas of 64².
const NETWORK: &str = r#"
[network]
body = "convolution"
patch = 8
layer_dims = [16, 32, 48, 64]
enc_dim = 64
enc_depth = 2
enc_heads = 4
dec_dim = 64
dec_depth = 2
dec_heads = 4
last_dim = 16
resolution = 64
net_resolution = 64
delta = 0.2
anchor = "ray"
window = true
mask_channel = true
ray_channels = true
mirror = true
[mode]
compat = false
"#;
/// People to train on, and one held-out person.
const PEOPLE: [(Split, usize); 2] = [(Split::Train, 5), (Split::Val, 1)];
/// Samples per step.
const BATCH: usize = 4;

/// Twelve views of every person, with exact depths.
fn data_set(root: &Path, resolution: usize) -> Result<Arc<Folder>, FileError> {
    let mut config = DataConfig::default();
    (config.views.count, config.views.resolution) = (12, resolution as u32);
    let people = PEOPLE.into_iter().flat_map(|(split, count)| (0..count).map(move |index| (split, index)));
    let people = people.map(|(split, index)| {
        let name = format!("{}-{index}", split.name());
        let mesh = synth::person(&name, None, Detail::of_pictures(resolution as u32));
        (split, name, mesh)
    });
    config.make(root, "examples/train_predictor.rs", people)
}

/// The losses of these samples.
fn compare(networks: &Networks, config: &Config, items: Vec<Stage1Item>, device: &Device) -> Vec<Part> {
    let predictor = networks.predictor.as_ref().expect("the predictor is trained");
    let batch = Stage1Batch::new(items, device);
    let mut record = Record::default();
    let masks = batch.masks.to_data().try_to_vec::<f32>().expect("numbers");
    let person = Window::around_person(&masks, config.network.resolution);
    let prediction = Prediction::new(predictor, config, batch.images, &batch.masks, person, &mut record);
    losses(&prediction, &batch.points, &batch.valid, 0.0)
}

/// Mean distance of predicted from true points over the four views, millimetres.
fn millimetres(losses: &[Part]) -> f32 {
    1e3 * losses[0].value.clone().into_scalar::<f32>() / View::ALL.len() as f32
}

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let steps: usize = arguments.next().map_or(Ok(400), |text| text.parse())?;
    let output = arguments.next().map(PathBuf::from);
    let device = Device::flex();
    let tracking = device.clone().autodiff();
    let config = Config::from_toml(NETWORK, "the example's network", &[])?;

    let temporary = tempfile::tempdir()?;
    let folder = data_set(&temporary.path().join("people"), config.network.resolution)?;
    let samples = |split| {
        let augment = Augment::none();
        let samples = SampleConfig { front_within_degrees: 30.0, augment, ..SampleConfig::default() };
        Stage1::new(folder.clone(), Some(split), samples)
    };
    let train = samples(Split::Train)?;
    let held_out = samples(Split::Val)?;
    let held_out: Vec<_> = (0..BATCH).map(|index| held_out.sample(index)).collect::<Result<_, _>>()?;
    let error =
        |networks: &Networks| millimetres(&compare(&networks.valid(), &config, held_out.clone(), &device));

    let predictor = Some(random_predictor(&config, 1, &tracking));
    let mut networks = Networks { predictor, regressors: Vec::new() };
    let before = error(&networks);
    let muon = Some(MuonSettings { rate: 5e-3 });
    let optimizer = OptimizerConfig { rate: 3e-3, beta2: 0.99, muon };
    let mut optimizer = optimizer.init(false);
    let schedule = Schedule::Cosine { warm_up: 10 };
    for step in 0..steps {
        let indices = step * BATCH..(step + 1) * BATCH;
        let items = indices.map(|index| train.sample(index)).collect::<Result<_, _>>()?;
        let losses = compare(&networks, &config, items, &tracking);
        if step % 20 == 0 {
            println!("step {step}: points {:.1} mm", millimetres(&losses));
        }
        let loss = losses.into_iter().map(|part| part.value * part.weight).reduce(|sum, part| sum + part);
        let rows = gradients::collect(&networks, &mut loss.expect("two parts").backward());
        let factor = gradients::clip_factor(gradients::norm(&rows), 1.0).ok_or("a gradient is not finite")?;
        let rows = optimizer.step(schedule.share(step, steps), &networks, rows, factor);
        networks = networks.with_rows(&rows);
    }
    if let Some(output) = output {
        save(&config, &networks.checkpoint(), &output)?;
    }
    println!("held-out person: {before:.1} mm before, {:.1} mm after", error(&networks));
    Ok(())
}
