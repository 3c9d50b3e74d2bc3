//! Who is compared: the model, what it is without something, others, and the baselines.

use std::time::Duration;

use burn::tensor::Device;
use snapsnap_data::sample::{Handling, TestItem};
use snapsnap_net::Photograph;
use snapsnap_splat::Gaussians;

use super::model::Model;
use super::person::{People, Points, nearest_view, photograph, points};
use super::sides::side_points;
use crate::EvalError;
use crate::baselines::{MeanPictures, billboard, true_points};
use crate::pictures::Picture;
use crate::points::{Pair, PointError, point_errors};

/// Azimuths of the right and the left side, degrees from the first photograph.
const SIDES: [f64; 2] = [90.0, 270.0];

/// What a contestant is to a report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Kind {
    /// What the report is about.
    #[default]
    Model,
    /// What it is compared with, person by person.
    Other,
    /// What anybody can do.
    Baseline,
}

/// Somebody who is compared.
pub struct Contestant {
    /// In reports.
    pub name: String,
    means: Means,
}

enum Means {
    Model(Kind, Box<Model>),
    Billboard(Device),
    TruePoints(Device),
    Mean(MeanPictures),
    Fixed(Box<Gaussians>),
}

/// What a contestant has to show of a person.
#[derive(Default)]
pub struct Shown {
    /// World frame; none where there are only pictures.
    pub gaussians: Option<Gaussians>,
    /// Errors of the predicted points.
    pub points: Vec<PointError>,
    /// Why there are none, where there could be.
    pub no_points: Option<String>,
    /// Pixels and Gaussians that were not finite.
    pub lost: usize,
    /// What it took.
    pub time: Option<Duration>,
}

impl Shown {
    /// Whether it is rendered by the processor.
    pub fn is_on_cpu(&self) -> bool {
        self.gaussians.as_ref().is_none_or(|gaussians| gaussians.device().identity().is_none())
    }
}

impl Contestant {
    /// What the report is about.
    pub fn model(name: &str, model: Model) -> Self {
        Self { name: name.into(), means: Means::Model(Kind::Model, Box::new(model)) }
    }

    /// What it is compared with.
    pub fn other(name: &str, model: Model) -> Self {
        Self { name: name.into(), means: Means::Model(Kind::Other, Box::new(model)) }
    }

    /// The photographs as cut-outs.
    pub fn billboard(device: &Device) -> Self {
        Self { name: "billboard".into(), means: Means::Billboard(device.clone()) }
    }

    /// True points in the photographs' colours.
    pub fn true_points(device: &Device) -> Self {
        Self { name: "true_points".into(), means: Means::TruePoints(device.clone()) }
    }

    /// The mean picture of people to train on.
    pub fn mean(pictures: MeanPictures) -> Self {
        Self { name: "mean_picture".into(), means: Means::Mean(pictures) }
    }

    /// Gaussians of one person (world frame), whoever is looked at.
    pub fn fixed(name: &str, gaussians: Gaussians) -> Self {
        Self { name: name.into(), means: Means::Fixed(Box::new(gaussians)) }
    }

    /// What it is to the report.
    pub fn kind(&self) -> Kind {
        match &self.means {
            Means::Model(kind, _) => *kind,
            _ => Kind::Baseline,
        }
    }

    /// The networks, where it has some.
    pub fn networks(&self) -> Option<&Model> {
        if let Means::Model(_, model) = &self.means { Some(model) } else { None }
    }

    /// What it makes of a person's photographs; baselines have a canvas of so many pixels on each side.
    ///
    /// # Errors
    /// [`EvalError`] if files cannot be read, or nothing came out.
    pub(super) fn prepare(
        &self,
        people: &People,
        row: usize,
        item: &TestItem,
        inputs: &[usize],
        canvas: usize,
    ) -> Result<Shown, EvalError> {
        let nothing = || EvalError::Empty("no Gaussian came out".into());
        let plain = |gaussians| Shown { gaussians: Some(gaussians), ..Shown::default() };
        match &self.means {
            Means::Model(_, model) => {
                let is_changed = model.photographs != Handling::default();
                let own = is_changed.then(|| people.item(row, inputs, &model.photographs)).transpose()?;
                let item = own.as_ref().unwrap_or(item);
                let made = model.reconstruct(item, inputs);
                if made.gaussians.is_empty() {
                    return Err(nothing());
                }
                // Pictures can be compared without them.
                let (points, no_points) = match errors(people, row, item, inputs, &made.maps, model.side()) {
                    Ok(points) => (points, None),
                    Err(e) => (Vec::new(), Some(e.to_string())),
                };
                let (gaussians, lost, time) = (Some(made.gaussians), made.lost, Some(made.time));
                Ok(Shown { gaussians, points, no_points, lost, time })
            }
            Means::Billboard(device) => {
                let (images, valid) = on_canvas(item, inputs.len(), canvas);
                let cameras: Vec<_> = inputs.iter().map(|view| item.cameras[*view]).collect();
                billboard(&images, &valid.concat(), canvas, &cameras, device).map(plain).ok_or_else(nothing)
            }
            Means::TruePoints(device) => {
                let mut views = inputs.to_vec();
                if inputs.len() == 2 {
                    views.extend(SIDES.map(|azimuth| nearest_view(&item.cameras, inputs[0], azimuth)));
                }
                let Some((points, there)) = points(people.test(), row, &views, item.side, canvas)? else {
                    let message = format!("views of {}² give no points on a canvas of {canvas}²", item.side);
                    return Err(EvalError::Empty(message));
                };
                let (images, mut valid) = on_canvas(item, inputs.len(), canvas);
                valid.resize(views.len(), vec![true; canvas * canvas]);
                for (valid, there) in valid.iter_mut().flatten().zip(there) {
                    *valid &= there > 0.5;
                }
                let front = &item.cameras[inputs[0]];
                let made = true_points(&images, inputs.len(), &points, &valid, canvas, front, device);
                made.map(plain).ok_or_else(nothing)
            }
            Means::Fixed(gaussians) => Ok(plain(gaussians.as_ref().clone())),
            Means::Mean(_) => Ok(Shown::default()),
        }
    }

    /// A view of what only has pictures.
    pub(super) fn picture(&self, view: usize, side: usize) -> Result<Picture, EvalError> {
        match &self.means {
            Means::Mean(pictures) => pictures.picture(view, side),
            _ => Err(EvalError::Empty("there is nothing to render".into())),
        }
    }
}

/// The photographs `[N,3,S,S]` on a canvas, and which pixels are at least half the person's: those have the person's own colour.
fn on_canvas(item: &TestItem, count: usize, side: usize) -> (Vec<f32>, Vec<Vec<bool>>) {
    // Networks see colours times the mask, and may have learned to undo that; baselines have not.
    let own = |photo: Photograph| {
        let Photograph { mut rgb, mask, valid } = photo;
        for plane in rgb.chunks_exact_mut(mask.len()) {
            plane.iter_mut().zip(&mask).for_each(|(v, m)| *v = (*v / m.max(0.5)).clamp(-1.0, 1.0));
        }
        (rgb, valid)
    };
    let photographs = (0..count).map(|place| photograph(item, place, side));
    let (images, valid): (Vec<_>, Vec<_>) = photographs.map(own).unzip();
    (images.concat(), valid)
}

/// Errors of predicted maps, by their places among [`crate::points::VIEWS`], at the pixels that have a true point.
fn errors(
    people: &People,
    row: usize,
    item: &TestItem,
    inputs: &[usize],
    maps: &[(usize, Vec<f32>)],
    side: usize,
) -> Result<Vec<PointError>, EvalError> {
    // More than two photographs are pairs, which have no one frame.
    if maps.is_empty() {
        return Ok(Vec::new());
    }
    let Some((photographed, there)) = points(people.test(), row, inputs, item.side, side)? else {
        return Ok(Vec::new());
    };
    let of_inputs = photographed.chunks_exact(3 * side * side).zip(there.chunks_exact(side * side));
    let mut truths: Vec<Points> =
        of_inputs.map(|(points, valid)| (points.to_vec(), valid.to_vec())).collect();
    for azimuth in SIDES {
        truths.push(side_points(people.test(), row, item, inputs[0], azimuth, side)?);
    }
    let with_truth = maps.iter().map(|(view, points)| (*view, points, &truths[*view]));
    let pairs = with_truth.map(|(view, points, (truth, valid))| Pair { view, points, truth, valid });
    Ok(point_errors(&pairs.collect::<Vec<_>>()))
}
