//! The header of any PLY file, of Gaussians or of triangles: format, elements and their properties.

use snapsnap_base::quoted;

/// Longest header that is read, in bytes.
pub const MAX_HEADER: usize = 1 << 20;

/// Most properties of an element, and most elements; a Gaussian has at most 62 properties.
const MAX_PROPERTIES: usize = 1000;

/// How the values of the body are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// Text, one row per line.
    Ascii,
    /// Numbers, lowest byte first.
    LittleEndian,
    /// Numbers, highest byte first.
    BigEndian,
}

/// Type of a value.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(missing_docs, reason = "the names say it")]
pub enum Scalar {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Scalar {
    fn parse(name: &str) -> Option<Self> {
        Some(match name {
            "char" | "int8" => Self::I8,
            "uchar" | "uint8" => Self::U8,
            "short" | "int16" => Self::I16,
            "ushort" | "uint16" => Self::U16,
            "int" | "int32" => Self::I32,
            "uint" | "uint32" => Self::U32,
            "float" | "float32" => Self::F32,
            "double" | "float64" => Self::F64,
            _ => return None,
        })
    }

    /// Bytes of a value in a binary body.
    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    /// The value at the start of little-endian `bytes`, which is exact in every type.
    pub fn read(self, bytes: [u8; 8]) -> f64 {
        let [a, b, c, d, ..] = bytes;
        match self {
            Self::I8 => f64::from(i8::from_le_bytes([a])),
            Self::U8 => f64::from(a),
            Self::I16 => f64::from(i16::from_le_bytes([a, b])),
            Self::U16 => f64::from(u16::from_le_bytes([a, b])),
            Self::I32 => f64::from(i32::from_le_bytes([a, b, c, d])),
            Self::U32 => f64::from(u32::from_le_bytes([a, b, c, d])),
            Self::F32 => f64::from(f32::from_le_bytes([a, b, c, d])),
            Self::F64 => f64::from_le_bytes(bytes),
        }
    }
}

/// A property of an element.
#[derive(Clone, Debug)]
pub struct Property {
    /// Name in the file.
    pub name: String,
    /// Type of the value, or of the list's values.
    pub kind: Scalar,
    /// Type of the length, if the property is a list.
    pub list: Option<Scalar>,
}

/// An element: `count` rows of `properties`.
#[derive(Clone, Debug)]
pub struct Element {
    /// Name in the file.
    pub name: String,
    /// Rows that the header promises.
    pub count: usize,
    /// Properties of each row, in order.
    pub properties: Vec<Property>,
}

/// The header.
#[derive(Clone, Debug)]
pub struct Header {
    /// How the body is written.
    pub format: Format,
    /// Elements in the order of the body.
    pub elements: Vec<Element>,
    /// Texts of the comments.
    pub comments: Vec<String>,
    /// Length of the header in bytes; the body follows.
    pub len: usize,
}

/// Reads the header at the start of `bytes`.
///
/// # Errors
/// A fault of the header, without the file's name.
pub fn parse(bytes: &[u8]) -> Result<Header, String> {
    let mut rest = &bytes[..bytes.len().min(MAX_HEADER)];
    let mut number = 0;
    let mut line = || -> Result<(usize, String), String> {
        number += 1;
        let end = rest.iter().position(|&b| b == b'\n').ok_or_else(|| match bytes.len() {
            0..=MAX_HEADER => "the header has no end: `end_header` is missing".to_owned(),
            _ => format!("the header is longer than {MAX_HEADER} bytes"),
        })?;
        let text =
            std::str::from_utf8(&rest[..end]).map_err(|_| format!("header line {number}: not text"))?;
        rest = &rest[end + 1..];
        Ok((number, text.trim_end_matches('\r').to_owned()))
    };
    if line().map_or(true, |(_, first)| first.trim_end() != "ply") {
        return Err("not a PLY file: it does not start with `ply`".into());
    }
    let mut format = None;
    let mut elements: Vec<Element> = Vec::new();
    let mut comments = Vec::new();
    loop {
        let (number, text) = line()?;
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let wrong = |problem: &str| Err(format!("header line {number}, `{}`: {problem}", quoted(&text)));
        match words.as_slice() {
            ["comment", ..] => {
                comments.push(text.trim_start().trim_start_matches("comment").trim().to_owned());
            }
            [] | ["obj_info", ..] => {}
            ["format", ..] if format.is_some() => return wrong("a second format"),
            ["format", name, _version] => {
                format = match *name {
                    "ascii" => Some(Format::Ascii),
                    "binary_little_endian" => Some(Format::LittleEndian),
                    "binary_big_endian" => Some(Format::BigEndian),
                    _ => return wrong("expected ascii, binary_little_endian or binary_big_endian"),
                };
            }
            ["element", name, count] => {
                let Ok(count) = count.parse() else { return wrong("the count is not a whole number") };
                if elements.len() == MAX_PROPERTIES || elements.iter().any(|e| e.name == *name) {
                    return wrong("a second element of this name, or too many of them");
                }
                elements.push(Element { name: (*name).to_owned(), count, properties: Vec::new() });
            }
            ["property", types @ .., name] => {
                let Some(element) = elements.last_mut() else { return wrong("no element before it") };
                let types = match types {
                    ["list", length, kind] => Scalar::parse(kind).zip(Scalar::parse(length).map(Some)),
                    [kind] => Scalar::parse(kind).map(|kind| (kind, None)),
                    _ => None,
                };
                let Some((kind, list)) = types else { return wrong("no such type") };
                if element.properties.len() == MAX_PROPERTIES {
                    return wrong("too many properties");
                }
                if element.properties.iter().any(|p| p.name == *name) {
                    return wrong("a second property of this name");
                }
                element.properties.push(Property { name: (*name).to_owned(), kind, list });
            }
            ["end_header"] => break,
            _ => return wrong("not understood"),
        }
    }
    let format = format.ok_or("the header names no format")?;
    let len = bytes.len().min(MAX_HEADER) - rest.len();
    Ok(Header { format, elements, comments, len })
}
