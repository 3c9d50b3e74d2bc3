//! `snapsnap studio`: a page (crates/app/viewer) that makes people of photographs, all in this process's memory.

use std::collections::{HashMap, VecDeque};
use std::io::Cursor;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, Weak};
use std::time::{Instant, SystemTime, UNIX_EPOCH};

use clap::Args;
use glam::Vec2;
use http::StatusCode;
use image::codecs::jpeg::JpegEncoder;
use image::imageops::{self, FilterType};
use image::{DynamicImage, GrayImage, ImageFormat};
use serde_json::{Value, json};
use snapsnap_mesh::picture;
use snapsnap_net::Reconstructor;
use snapsnap_photo::{Content, Cutting, Doubt, Figure, Joint, Sign, Source, cut_out, person};
use snapsnap_splat::scene::Stored;

use crate::downloads::{self, Download};
use crate::failure::Failure;
use crate::model::{CameraArguments, ModelArguments, check_memory};
use crate::page::{self, Job, PageArguments, text};
use crate::server::{self, Answer, Body, Refusal, Request};

#[derive(Args)]
pub struct Arguments {
    #[command(flatten)]
    camera: CameraArguments,
    #[command(flatten)]
    model: ModelArguments,
    #[command(flatten)]
    page: PageArguments,
}

/// Largest photograph in bytes, as the page knows it (crates/app/viewer/src/studio.js), and largest picture of strokes.
const LARGEST: u64 = 128 << 20;
const LARGEST_STROKES: u64 = 4 << 20;
/// Bytes of decoded strokes.
const STROKES: u64 = 64 << 20;
/// Longer side of the page's pictures in pixels, and their JPEG quality.
const PREVIEW: u32 = 1024;
const QUALITY: u8 = 90;
/// Number of people in memory.
const KEPT: usize = 4;

struct Studio {
    /// What the user says on the command line.
    camera: CameraArguments,
    /// For one job at a time.
    networks: Mutex<Reconstructor>,
    /// The last people, under their names in addresses.
    people: Mutex<VecDeque<(String, Arc<Person>)>>,
    /// Number of people so far.
    made: AtomicUsize,
    /// Start of this server, a part of names: a page of an earlier server finds none of its people here.
    start: u128,
}

/// A person, and its files that clients are reading, by extension: those that are made at once, and those that take long.
struct Person {
    stored: Stored,
    files: [Mutex<HashMap<&'static str, Weak<server::Bytes>>>; 2],
}

pub fn run(arguments: &Arguments) -> Result<(), Failure> {
    let weights = arguments.model.open()?;
    arguments.camera.told(&weights.config, false)?;
    let device = arguments.model.device(&weights)?;
    let (networks, _) = arguments.model.load(&weights, &device)?;
    let studio = Studio {
        camera: arguments.camera,
        networks: Mutex::new(networks),
        people: Mutex::default(),
        made: AtomicUsize::new(0),
        start: SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos()),
    };
    let rest = |request: &Request, body: &mut Body| studio.respond(request, body);
    page::show("studio", &arguments.page, "the studio is open", &rest)
}

impl Studio {
    /// The answer, or in an error the answer that refuses.
    fn respond(&self, request: &Request, body: &mut Body) -> Result<Answer, Answer> {
        match (request.method.as_str(), request.path.as_str()) {
            ("POST", "/cutout") => self.cut_out(request, body),
            ("POST", "/reconstruct") => self.reconstruct(request, body),
            ("GET" | "HEAD", "/progress") => Ok(page::progress(request)),
            ("GET" | "HEAD", path) => self.download(request, path),
            ("POST", _) => Err(text(StatusCode::NOT_FOUND, "no such page")),
            _ => Err(text(StatusCode::METHOD_NOT_ALLOWED, "GET, HEAD and POST only")),
        }
    }

    /// The networks, after all earlier jobs. Refuses a client that has left meanwhile.
    fn networks(&self, job: &Job, body: &Body) -> Result<MutexGuard<'_, Reconstructor>, Answer> {
        job.step("waiting for another page");
        let networks = self.networks.lock().unwrap_or_else(PoisonError::into_inner);
        let closed = || text(StatusCode::REQUEST_TIMEOUT, "the page was closed");
        body.is_awaited().then_some(networks).ok_or_else(closed)
    }

    /// A photograph → its picture, as JPEG, and the person's mask, as PNG, both reduced to [`PREVIEW`]; as JSON the
    /// joints, each column, row (shares of the picture) and probability of being seen, and what is wrong.
    fn cut_out(&self, request: &Request, body: &mut Body) -> Result<Answer, Answer> {
        let upload = body.read(LARGEST)?;
        let job = Job::of(request);
        let name = Path::new("this photograph");
        check_memory(name, picture::size(name, Some(upload.as_ref()))?)?;
        let networks = self.networks(&job, body)?;
        job.step("removing the background");
        let source = Source { content: Content::Bytes(upload.as_ref()), ..Source::file(name) };
        let Figure { rgb, mask, joints, signs } = cut_out(source, Cutting::Missing)?;
        drop((networks, upload));
        let [width, height] = reduced(rgb.width(), rgb.height());
        let small = imageops::resize(&rgb, width, height, FilterType::Triangle);
        let mask = imageops::resize(&mask, width, height, FilterType::Triangle);
        let (mut content, mut png) = (Vec::new(), Vec::new());
        let cannot = |e| Failure::Internal(format!("a preview: cannot encode: {e}"));
        JpegEncoder::new_with_quality(&mut content, QUALITY).encode_image(&small).map_err(cannot)?;
        mask.write_to(&mut Cursor::new(&mut png), ImageFormat::Png).map_err(cannot)?;
        let whole = Vec2::new(rgb.width() as f32, rgb.height() as f32);
        let joint = |Joint { at, seen }: &Joint| [at.x / whole.x, at.y / whole.y, *seen];
        let signs = signs.iter().map(|sign| said(sign.to_string(), sign));
        let seen = json!({
            "joints": joints.iter().map(joint).collect::<Vec<_>>(),
            "signs": signs.collect::<Vec<_>>(),
        });
        let mut seen = seen.to_string().into_bytes();
        let lengths = format!("{},{},{}", content.len(), png.len(), seen.len());
        content.append(&mut png);
        content.append(&mut seen);
        let mut answer = page::answer("application/octet-stream", Arc::new(content));
        answer.headers.push(("X-Parts", lengths));
        Ok(answer)
    }

    /// Two photographs and the strokes of each (a PNG or nothing) → the name of a person in memory.
    fn reconstruct(&self, request: &Request, body: &mut Body) -> Result<Answer, Answer> {
        let upload = body.read(2 * (LARGEST + LARGEST_STROKES))?;
        let start = Instant::now();
        let job = Job::of(request);
        let [front, back, front_strokes, back_strokes] = parts(request, upload.as_ref())?;
        let names = ["front photograph", "back photograph"].map(Path::new);
        let photographs = [front, back];
        for (name, bytes) in names.into_iter().zip(photographs) {
            check_memory(name, picture::size(name, Some(bytes))?)?;
        }
        let networks = self.networks(&job, body)?;
        // Decoded strokes are larger than an upload: only one job at a time has them.
        let strokes = [strokes("front strokes", front_strokes)?, strokes("back strokes", back_strokes)?];
        let sources = [0, 1].map(|i| {
            let content = Content::Bytes(photographs[i]);
            Source { content, strokes: strokes[i].as_ref(), ..Source::file(names[i]) }
        });
        job.step("photographs");
        let config = networks.config();
        let told = self.camera.updated(request.header("x-told").unwrap_or("{}"));
        // A page has no options, whose dashes the message begins with.
        let wrong =
            |e: Failure| text(StatusCode::UNPROCESSABLE_ENTITY, e.to_string().trim_start_matches('-'));
        let told = &told.and_then(|camera| camera.told(config, false)).map_err(wrong)?;
        let (side, placement) = (config.network.resolution, told.placement(config));
        let mut read = snapsnap_photo::read(&sources, Cutting::Missing, side, placement, told.focal)?;
        read.cutouts = Vec::new();
        let person = person(&read, &networks, told, &|step| job.step(step)).map_err(Failure::from)?;
        let doubt = |doubt: &Doubt| {
            let mut said = said(doubt.to_string(), &doubt.sign);
            said["of"] = json!(doubt.photographs);
            said
        };
        let doubts: Vec<Value> = read.doubts.iter().map(doubt).collect();
        let stored = Stored::of(&person.gaussians).map_err(Failure::from)?;
        // Frees buffers, since the next person may come in an hour.
        snapsnap_ops::release_buffers();
        drop(networks);
        let name = format!("{:x}-{}", self.start, self.made.fetch_add(1, Ordering::Relaxed));
        let gaussians = stored.len();
        let mut people = self.people.lock().unwrap_or_else(PoisonError::into_inner);
        people.truncate(KEPT - 1);
        people.push_front((name.clone(), Arc::new(Person { stored, files: Default::default() })));
        let seconds = start.elapsed().as_secs_f64();
        let made = json!({ "name": name, "gaussians": gaussians, "seconds": seconds, "warnings": doubts });
        Ok(page::answer("application/json", Arc::new(made.to_string())))
    }

    /// A file of a person in memory: `/people/NAME/scene.spz`.
    fn download(&self, request: &Request, path: &str) -> Result<Answer, Answer> {
        let none = || text(StatusCode::NOT_FOUND, "no such page");
        let (name, file) =
            path.strip_prefix("/people/").and_then(|rest| rest.split_once('/')).ok_or_else(none)?;
        let (extension, download) = Download::named(file).ok_or_else(none)?;
        let people = self.people.lock().unwrap_or_else(PoisonError::into_inner);
        let found = people.iter().find(|(other, _)| other == name).map(|(_, person)| person.clone());
        drop(people);
        let message = format!("this person is no longer in memory (the last {KEPT} are kept): make it again");
        let person = found.ok_or_else(|| text(StatusCode::NOT_FOUND, &message))?;
        downloads::answer(request, "human", (extension, download), |step| {
            let files = &person.files[usize::from(download.is_long())];
            let mut files = files.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(content) = files.get(extension).and_then(Weak::upgrade) {
                return Ok(content);
            }
            let content: server::Content = Arc::new(download.make(&person.stored, step)?);
            files.insert(extension, Arc::downgrade(&content));
            Ok(content)
        })
    }
}

/// What is wrong with photographs: as a whole text, and as a note beside parts of the body.
fn said(text: String, sign: &Sign) -> Value {
    let (note, parts) = sign.of_parts();
    json!({ "text": text, "note": note, "parts": parts })
}

/// The size of a picture whose longer side is at most [`PREVIEW`].
fn reduced(width: u32, height: u32) -> [u32; 2] {
    let longer = width.max(height).max(PREVIEW);
    [width, height].map(|side| (u64::from(side) * u64::from(PREVIEW) / u64::from(longer)).max(1) as u32)
}

/// The parts of a body, whose lengths `X-Parts` lists.
fn parts<'a, const N: usize>(request: &Request, body: &'a [u8]) -> Result<[&'a [u8]; N], Refusal> {
    const WRONG: Refusal = (StatusCode::BAD_REQUEST, "X-Parts does not fit the body");
    let lengths: Vec<&str> = request.header("x-parts").unwrap_or_default().split(',').collect();
    let lengths: [&str; N] = lengths.try_into().map_err(|_| WRONG)?;
    let mut rest = body;
    let mut found = [&body[..0]; N];
    for (part, length) in found.iter_mut().zip(lengths) {
        let length = length.trim().parse().map_err(|_| WRONG)?;
        (*part, rest) = rest.split_at_checked(length).ok_or(WRONG)?;
    }
    if rest.is_empty() { Ok(found) } else { Err(WRONG) }
}

/// Strokes of the page's brush; `None` if there are none.
fn strokes(name: &str, bytes: &[u8]) -> Result<Option<GrayImage>, Failure> {
    let decode = || picture::decode_bytes(Path::new(name), bytes, STROKES);
    Ok((!bytes.is_empty()).then(decode).transpose()?.map(DynamicImage::into_luma8))
}
