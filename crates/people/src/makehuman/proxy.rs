//! Clothes, hair, hats and shoes of MakeHuman's asset collection: meshes bound to the base mesh (`.mhclo` and `.obj`).

use std::path::Path;
use std::sync::Arc;

use glam::{Vec2, Vec3};
use rand::Rng;
use snapsnap_base::{FileError, folder};
use snapsnap_mesh::mesh::pieces;

use super::files::{Face, METRES, numbers, read_obj, read_text, vector, wrong};
use super::patch::{Patch, Vertex};
use crate::pattern::Pattern;
use crate::synth::outfit::{Cut, Outfit};

/// Share of people in a suit of the collection, among people without a skirt or a coat.
const SUITS: f32 = 0.7;
/// Share of people in shoes of the collection, among people without a suit of the collection.
const SHOES: f32 = 0.4;
/// Share of people with hair of the collection, among people who are not bald and have no cap.
const HAIR: f32 = 0.65;
/// Share of people with a hat of the collection.
const HATS: f32 = 0.06;

/// Purpose of a proxy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Kind {
    /// Top and bottom.
    Suit,
    Shoes,
    Hat,
    Hair,
}

/// Largest scale of offsets. Larger bodies come from damaged files.
const MAX_SCALE: f32 = 10.0;

/// Binding of a vertex: a weighted sum of base mesh vertices, and an offset in metres before scaling.
#[derive(Debug, Clone, Copy)]
struct Binding {
    shares: [(u32, f32); 3],
    offset: Vec3,
}

/// Two vertices of the base mesh, and the distance along an axis, metres, for which the offsets were made.
type Scale = ([u32; 2], f32);

/// A proxy.
#[derive(Debug, Clone)]
pub struct Proxy {
    /// File name in lower case.
    name: String,
    /// Clothes have their kind in their tags.
    kind: Kind,
    bindings: Vec<Binding>,
    /// For x, y and z.
    scales: [Option<Scale>; 3],
    /// By vertex of the base mesh: whether the proxy covers it, so that it is left out.
    pub hides: Vec<bool>,
    faces: Vec<Face>,
}

/// A proxy on a body, in connected pieces.
pub struct Fitted {
    pub patch: Patch,
    /// Texture coordinates of the faces' corners.
    pub texcoords: Vec<Vec<Vec2>>,
    /// By face: index of its piece. The largest piece is 0.
    pub pieces: Vec<usize>,
}

/// Reads the proxies in the folders `clothes` and `hair` of MakeHuman's `data`, for a base mesh of `vertices` vertices.
/// Missing folders are empty. Unused proxies are read, too, so that damaged files are always found.
///
/// # Errors
/// [`FileError`] for a file that is damaged or cannot be read.
pub fn wardrobe(root: &Path, vertices: usize) -> Result<Vec<Arc<Proxy>>, FileError> {
    let mut proxies = Vec::new();
    for folder in ["clothes", "hair"] {
        let path = root.join(folder);
        let assets = if path.is_dir() { folder::entries(&path)? } else { Vec::new() };
        for asset in assets.iter().filter(|asset| asset.is_dir()) {
            for path in folder::with_ending(asset, "mhclo")? {
                let mut proxy = Proxy::read(&path, vertices)?;
                if folder == "hair" {
                    proxy.kind = Kind::Hair;
                }
                proxies.push(Arc::new(proxy));
            }
        }
    }
    Ok(proxies)
}

/// A random proxy of this kind for this sex, 0 female and 1 male.
fn choose(wardrobe: &[Arc<Proxy>], kind: Kind, sex: f32, random: &mut impl Rng) -> Option<Arc<Proxy>> {
    let other = if sex < 0.5 { "male_" } else { "female_" };
    let fits = |proxy: &&Arc<Proxy>| proxy.kind == kind && !proxy.name.starts_with(other);
    let fitting: Vec<&Arc<Proxy>> = wardrobe.iter().filter(fits).collect();
    let draw: f32 = random.random_range(0.0..1.0);
    fitting.get((draw * fitting.len() as f32) as usize).copied().cloned()
}

/// The proxies that a person wears.
pub struct Worn {
    pub suit: Option<Arc<Proxy>>,
    pub shoes: Option<Arc<Proxy>>,
    pub hair: Option<Arc<Proxy>>,
    pub hat: Option<Arc<Proxy>>,
    /// Cloth of hats, and of garments between top and bottom.
    pub other: Pattern,
}

impl Worn {
    pub fn draw(
        wardrobe: &[Arc<Proxy>],
        outfit: &Outfit,
        sex: f32,
        is_draped: bool,
        random: &mut impl Rng,
    ) -> Self {
        let [suit, shoes, hair, hat] = [(); 4].map(|()| random.random_range(0.0..1.0_f32));
        let mut choose =
            |kind: Kind, is_wanted: bool| choose(wardrobe, kind, sex, random).filter(|_| is_wanted);
        let own_shoes = choose(Kind::Shoes, true);
        let suit = choose(Kind::Suit, !is_draped && suit < SUITS && own_shoes.is_some());
        let has_shoes = suit.is_some() || shoes < SHOES;
        let has_hair = !matches!(outfit.cut, Cut::Bald | Cut::Cap);
        let hair = choose(Kind::Hair, has_hair && hair < HAIR);
        let hat = choose(Kind::Hat, has_hair && hat < HATS);
        let other = Pattern::draw_quiet(random);
        Self { suit, shoes: own_shoes.filter(|_| has_shoes), hair, hat, other }
    }

    /// Whether a vertex of the base mesh lies below clothes.
    pub fn hides(&self, row: u32) -> bool {
        let worn = [&self.suit, &self.shoes];
        worn.into_iter().flatten().any(|proxy| proxy.hides.get(row as usize) == Some(&true))
    }
}

impl Proxy {
    /// Reads a proxy for a base mesh of `vertices` vertices.
    ///
    /// # Errors
    /// [`FileError`] naming the file and the line.
    pub fn read(path: &Path, vertices: usize) -> Result<Self, FileError> {
        let text = read_text(path)?;
        let mut proxy = Self {
            name: path.file_name().unwrap_or_default().to_string_lossy().to_lowercase(),
            kind: Kind::Suit,
            bindings: Vec::new(),
            scales: [None; 3],
            hides: vec![false; vertices],
            faces: Vec::new(),
        };
        let mut mesh = None;
        let (mut is_list, mut is_hidden) = (false, false);
        let inside = |row: &u32| (*row as usize) < vertices;
        for (number, line) in text.lines().enumerate() {
            let mut words = line.split_ascii_whitespace();
            let Some(first) = words.next().filter(|word| !word.starts_with('#')) else { continue };
            let bad = || wrong(path, number, line);
            let is_number = first.starts_with(|c: char| c.is_ascii_digit());
            match first {
                _ if is_number && is_hidden => hide(line, &mut proxy.hides).ok_or_else(bad)?,
                _ if is_number && is_list => proxy.bindings.push(binding(line, vertices).ok_or_else(bad)?),
                "obj_file" => mesh = words.next(),
                "tag" => match words.next().map(str::to_ascii_lowercase).as_deref() {
                    Some("shoes") => proxy.kind = Kind::Shoes,
                    Some("hats") if proxy.kind == Kind::Suit => proxy.kind = Kind::Hat,
                    _ => {}
                },
                "verts" => (is_list, is_hidden) = (true, false),
                "delete_verts" => (is_list, is_hidden) = (false, true),
                "x_scale" | "y_scale" | "z_scale" => {
                    let rows: [u32; 2] =
                        numbers(&mut words).filter(|rows| rows.iter().all(inside)).ok_or_else(bad)?;
                    let length = numbers(&mut words).filter(|[l]: &[f32; 1]| *l > 0.0 && l.is_finite());
                    let [length] = length.ok_or_else(bad)?;
                    let axis = usize::from(first.as_bytes()[0] - b'x');
                    proxy.scales[axis] = Some((rows, METRES * length));
                }
                _ => {}
            }
        }
        let name = mesh.and_then(|name| Path::new(name).file_name());
        let name = name.ok_or_else(|| FileError::unsuitable(path, "names no `obj_file`"))?;
        let (path, bindings) = (path.with_file_name(name), proxy.bindings.len());
        let (positions, faces) = read_obj(&path)?;
        if positions.len() != bindings || faces.is_empty() {
            let (vertices, faces) = (positions.len(), faces.len());
            let message = format!("has {vertices} vertices and {faces} faces for {bindings} bindings");
            return Err(FileError::unsuitable(&path, message));
        }
        Ok(Self { faces, ..proxy })
    }

    /// Fits the proxy to a body. `bones` moves a resting point by the skin weights of a mixture of base mesh vertices.
    pub fn fit(&self, body: &[Vertex], bones: impl Fn(&[(u32, f32)], Vec3) -> Vec3) -> Fitted {
        let scale = |axis: usize| {
            self.scales[axis].map_or(1.0, |([a, b], length)| {
                let apart = body[a as usize].rest[axis] - body[b as usize].rest[axis];
                (apart.abs() / length).min(MAX_SCALE)
            })
        };
        let scale = Vec3::new(scale(0), scale(1), scale(2));
        let vertex = |binding: &Binding| {
            let at = |(row, share): &(u32, f32)| *share * body[*row as usize].rest;
            let rest = binding.shares.iter().map(at).sum::<Vec3>() + binding.offset * scale;
            // Negative shares lie beyond the triangle; bones follow the triangle's corners.
            let mut kept = binding.shares.map(|(row, share)| (row, share.max(0.0)));
            let sum: f32 = kept.iter().map(|(_, share)| share).sum();
            if sum > 0.0 {
                kept.iter_mut().for_each(|(_, share)| *share /= sum);
            } else {
                kept[0].1 = 1.0;
            }
            let parts = std::array::from_fn(|part| {
                kept.iter().map(|(row, share)| share * body[*row as usize].parts[part]).sum()
            });
            Vertex { rest, posed: bones(&kept, rest), parts }
        };
        let vertices: Vec<Vertex> = self.bindings.iter().map(vertex).collect();
        let patch = Patch { vertices, faces: self.faces.iter().map(|face| face.rows.clone()).collect() };
        let pieces = pieces(patch.vertices.len(), patch.faces.iter().map(|face| &face[..]));
        let texcoords = self.faces.iter().map(|face| face.texcoords.clone()).collect();
        Fitted { patch, texcoords, pieces }
    }
}

impl Fitted {
    /// One step of [`Patch::subdivide`].
    pub fn subdivide(&self) -> Self {
        let patch = self.patch.subdivide();
        let mut texcoords = Vec::with_capacity(patch.faces.len());
        let mut pieces = Vec::with_capacity(patch.faces.len());
        for (corners, piece) in self.texcoords.iter().zip(&self.pieces) {
            let count = corners.len();
            let middle = corners.iter().sum::<Vec2>() / count as f32;
            for (i, corner) in corners.iter().enumerate() {
                let (before, after) = (corners[(i + count - 1) % count], corners[(i + 1) % count]);
                texcoords.push(vec![*corner, 0.5 * (*corner + after), middle, 0.5 * (before + *corner)]);
                pieces.push(*piece);
            }
        }
        Self { patch, texcoords, pieces }
    }
}

/// A line of the list of vertices: one vertex of the base mesh, or three with their shares and an offset.
fn binding(line: &str, vertices: usize) -> Option<Binding> {
    let mut words = line.split_ascii_whitespace();
    let inside = |row: &u32| (*row as usize) < vertices;
    if words.clone().count() == 1 {
        let [row] = numbers(&mut words).filter(|rows: &[u32; 1]| rows.iter().all(inside))?;
        return Some(Binding { shares: [(row, 1.0), (row, 0.0), (row, 0.0)], offset: Vec3::ZERO });
    }
    let rows = numbers(&mut words).filter(|rows: &[u32; 3]| rows.iter().all(inside))?;
    let is_small = |shares: &[f32; 3]| shares.iter().all(|share| share.abs() < 100.0);
    let shares = numbers(&mut words).filter(is_small)?;
    Some(Binding { shares: [0, 1, 2].map(|i| (rows[i], shares[i])), offset: vector(words)? })
}

/// Marks the vertices of a line such as `1355 - 1388 1393`.
fn hide(line: &str, hides: &mut [bool]) -> Option<()> {
    let mut last: Option<usize> = None;
    let mut is_range = false;
    for word in line.split_ascii_whitespace() {
        if word == "-" {
            is_range = true;
            continue;
        }
        let row: usize = word.parse().ok()?;
        let first = if is_range { last? } else { row };
        hides.get_mut(first..=row)?.fill(true);
        (last, is_range) = (Some(row), false);
    }
    Some(())
}
