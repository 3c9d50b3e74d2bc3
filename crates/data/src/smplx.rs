//! The direction that a scan faces, from its SMPL-X parameters: THuman's `smplx_param.pkl`, or JSON.
//!
//! A pickle is a program for a stack machine that may call any function. The machine of this file calls no function. It
//! stores calls as data, and recognises the calls that make NumPy's arrays.

use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;

use serde_json::Value as Json;

use snapsnap_base::{FileError, file};

/// Largest file that is read, in bytes. Parameters take a few kilobytes.
const MAX_BYTES: u64 = 16 << 20;
/// Largest number of operations of a pickle. Parameters take a few hundred.
const MAX_OPERATIONS: usize = 10_000;
/// Largest number of lists and numbers in a parameter.
const MAX_NODES: usize = 100;
/// The parameter of the body's orientation: an axis times an angle in radians.
const ORIENTATION: &str = "global_orient";

/// Angle in degrees, around +y, from +z to the direction that the body faces. As in the published code, `global_orient`
/// is treated as a pure rotation around y by its second component (docs/method.md, "Cameras").
///
/// # Errors
/// [`FileError`] for a file that cannot be read or has no orientation of three finite numbers.
pub fn yaw_degrees(path: &Path) -> Result<f64, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    let is_json = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("json"));
    let orientation = if is_json { from_json(&bytes) } else { from_pickle(&bytes) };
    let orientation = orientation
        .map_err(|e| FileError::unsuitable(path, format!("is no file of SMPL-X parameters: {e}")))?;
    match orientation[..] {
        [x, y, z] if [x, y, z].iter().all(|v| v.is_finite()) => Ok(y.to_degrees()),
        _ => {
            let message = format!("`{ORIENTATION}` is {orientation:?}, expected three numbers");
            Err(FileError::unsuitable(path, message))
        }
    }
}

fn from_json(bytes: &[u8]) -> Result<Vec<f64>, String> {
    let json: Json = serde_json::from_slice(bytes).map_err(|e| e.to_string())?;
    let mut value = json.get(ORIENTATION).ok_or_else(|| format!("`{ORIENTATION}` is missing"))?;
    // Some exporters write a batch of one.
    while let Some([Json::Array(_)]) = value.as_array().map(Vec::as_slice) {
        value = &value[0];
    }
    let numbers = value.as_array().and_then(|list| list.iter().map(Json::as_f64).collect());
    numbers.ok_or_else(|| format!("`{ORIENTATION}` is no list of numbers"))
}

fn from_pickle(bytes: &[u8]) -> Result<Vec<f64>, String> {
    let Value::Dict(entries) = unpickle(bytes)? else { return Err("it holds no dictionary".into()) };
    let entries = entries.borrow();
    let value = entries
        .chunks_exact(2)
        .find(|pair| matches!(&pair[0], Value::Bytes(key) if **key == *ORIENTATION.as_bytes()));
    let value = &value.ok_or_else(|| format!("`{ORIENTATION}` is missing"))?[1];
    numbers(value, &mut { MAX_NODES }).ok_or_else(|| format!("`{ORIENTATION}` is no array of numbers"))
}

/// A value of a pickle. Containers are shared, as in Python.
#[derive(Clone, Debug)]
enum Value {
    None,
    Mark,
    Number(f64),
    /// Bytes, or text in UTF-8. Strings of Python 2 may be either.
    Bytes(Rc<[u8]>),
    /// A list or a tuple.
    List(Rc<RefCell<Vec<Value>>>),
    /// Keys and values in turn.
    Dict(Rc<RefCell<Vec<Value>>>),
    /// A call: its function, its arguments, and the state that is set afterwards.
    Object(Rc<RefCell<Vec<Value>>>),
}

fn shared(values: Vec<Value>) -> Rc<RefCell<Vec<Value>>> {
    Rc::new(RefCell::new(values))
}

/// The numbers of a NumPy array or scalar, or of a list, in order.
fn numbers(value: &Value, nodes: &mut usize) -> Option<Vec<f64>> {
    // Lists that share their elements may contain exponentially many values.
    *nodes = nodes.checked_sub(1)?;
    match value {
        Value::Number(number) => Some(vec![*number]),
        Value::List(items) => {
            let items = items.borrow();
            let nested: Option<Vec<Vec<f64>>> = items.iter().map(|item| numbers(item, nodes)).collect();
            Some(nested?.concat())
        }
        Value::Object(parts) => {
            let parts = parts.borrow();
            let (bytes, dtype) = match parts.as_slice() {
                // _reconstruct(…) with the state (version, shape, dtype, is_fortran, bytes).
                [Value::Bytes(_), _, Value::List(state)] => match state.borrow().as_slice() {
                    [_, _, Value::Object(dtype), _, bytes] => (raw(bytes)?, dtype.clone()),
                    _ => return None,
                },
                // NumPy 2: _frombuffer(bytes, dtype, shape, order).
                [Value::Bytes(name), Value::List(arguments)] if name.ends_with(b"._frombuffer") => {
                    match arguments.borrow().as_slice() {
                        [bytes, Value::Object(dtype), ..] => (raw(bytes)?, dtype.clone()),
                        _ => return None,
                    }
                }
                _ => return None,
            };
            let dtype = dtype.borrow();
            let Some(Value::List(arguments)) = dtype.get(1) else { return None };
            let arguments = arguments.borrow();
            let Some(Value::Bytes(kind)) = arguments.first() else { return None };
            let is_big_endian = matches!(dtype.get(2), Some(Value::List(state))
                if matches!(state.borrow().get(1), Some(Value::Bytes(order)) if **order == *b">"));
            match &**kind {
                b"f8" => {
                    let read = if is_big_endian { f64::from_be_bytes } else { f64::from_le_bytes };
                    Some(bytes.as_chunks().0.iter().map(|b| read(*b)).collect())
                }
                b"f4" => {
                    let read = if is_big_endian { f32::from_be_bytes } else { f32::from_le_bytes };
                    Some(bytes.as_chunks().0.iter().map(|b| f64::from(read(*b))).collect())
                }
                _ => None,
            }
        }
        _ => None,
    }
}

/// The bytes of a value. In protocol 2, Python 3 writes bytes as a call that encodes text as Latin-1.
fn raw(value: &Value) -> Option<Rc<[u8]>> {
    match value {
        Value::Bytes(bytes) => Some(bytes.clone()),
        Value::Object(parts) => {
            let parts = parts.borrow();
            let [Value::Bytes(name), Value::List(arguments)] = parts.as_slice() else { return None };
            let arguments = arguments.borrow();
            let Some(Value::Bytes(text)) = arguments.first().filter(|_| **name == *b"_codecs.encode") else {
                return None;
            };
            let text = std::str::from_utf8(text).ok()?;
            text.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect()
        }
        _ => None,
    }
}

/// Runs a pickle of protocol 2 to 5 with the operations of SMPL-X parameters.
fn unpickle(bytes: &[u8]) -> Result<Value, String> {
    let mut machine = Machine { rest: bytes, stack: Vec::new(), memo: Vec::new() };
    for _ in 0..MAX_OPERATIONS {
        let operation = machine.take(1)?[0];
        if operation == b'.' {
            return machine.pop();
        }
        machine.run(operation)?;
    }
    Err(format!("it has more than {MAX_OPERATIONS} steps"))
}

struct Machine<'a> {
    rest: &'a [u8],
    stack: Vec<Value>,
    memo: Vec<Value>,
}

impl<'a> Machine<'a> {
    fn take(&mut self, length: usize) -> Result<&'a [u8], String> {
        let (taken, rest) = self.rest.split_at_checked(length).ok_or("it is cut off")?;
        self.rest = rest;
        Ok(taken)
    }

    /// A little-endian integer of `bytes` bytes.
    fn whole(&mut self, bytes: usize) -> Result<usize, String> {
        let taken = self.take(bytes)?;
        Ok(taken.iter().rev().fold(0, |sum, byte| sum << 8 | usize::from(*byte)))
    }

    fn line(&mut self) -> Result<&'a [u8], String> {
        let end = self.rest.iter().position(|b| *b == b'\n').ok_or("it is cut off")?;
        Ok(&self.take(end + 1)?[..end])
    }

    fn pop(&mut self) -> Result<Value, String> {
        self.stack.pop().ok_or_else(|| "it takes from an empty stack".into())
    }

    /// Everything above the topmost mark.
    fn above_mark(&mut self) -> Result<Vec<Value>, String> {
        let mark = self.stack.iter().rposition(|v| matches!(v, Value::Mark)).ok_or("a mark is missing")?;
        let values = self.stack.split_off(mark + 1);
        self.stack.pop();
        Ok(values)
    }

    fn last(&mut self, count: usize) -> Result<Vec<Value>, String> {
        let at = self.stack.len().checked_sub(count).ok_or("it takes from an empty stack")?;
        Ok(self.stack.split_off(at))
    }

    /// Adds to the list or dictionary on top.
    fn add(&mut self, values: Vec<Value>) -> Result<(), String> {
        match self.stack.last() {
            Some(Value::List(items) | Value::Dict(items)) => items.borrow_mut().extend(values),
            // Items of an object of another class are not needed.
            Some(Value::Object(_)) => {}
            _ => return Err("it adds to a value that is no container".into()),
        }
        Ok(())
    }

    fn remember(&mut self, at: usize) -> Result<(), String> {
        let value = self.stack.last().cloned().ok_or("it takes from an empty stack")?;
        if at > MAX_OPERATIONS {
            return Err("its memo is too large".into());
        }
        if self.memo.len() <= at {
            self.memo.resize(at + 1, Value::None);
        }
        self.memo[at] = value;
        Ok(())
    }

    fn run(&mut self, operation: u8) -> Result<(), String> {
        let value = match operation {
            // Protocol and frame are ignored.
            0x80 => return self.take(1).map(drop),
            0x95 => return self.take(8).map(drop),
            b'(' => Value::Mark,
            b'0' => return self.pop().map(drop),
            b'2' => self.stack.last().cloned().ok_or("it takes from an empty stack")?,
            b'N' => Value::None,
            0x88 => Value::Number(1.0),
            0x89 => Value::Number(0.0),
            b'J' => Value::Number(f64::from(self.whole(4)? as u32 as i32)),
            b'K' => Value::Number(self.whole(1)? as f64),
            b'M' => Value::Number(self.whole(2)? as f64),
            0x8a => {
                let length = self.whole(1)?;
                if length > 8 {
                    return Err("a number is too long".into());
                }
                let sum = self.whole(length)? as u64;
                // The topmost bit is the sign.
                let shift = 64 - 8 * length as u32;
                Value::Number(if length == 0 { 0.0 } else { ((sum << shift) as i64 >> shift) as f64 })
            }
            b'G' => {
                let bytes = self.take(8)?.try_into().map_err(|_| "it is cut off")?;
                Value::Number(f64::from_be_bytes(bytes))
            }
            b'X' | b'T' | b'B' | 0x8c | b'U' | b'C' | 0x8d | 0x8e | 0x96 => {
                let length = self.whole(match operation {
                    b'X' | b'T' | b'B' => 4,
                    0x8c | b'U' | b'C' => 1,
                    _ => 8,
                })?;
                Value::Bytes(self.take(length)?.into())
            }
            b'}' => Value::Dict(shared(Vec::new())),
            b']' | b')' => Value::List(shared(Vec::new())),
            b't' => Value::List(shared(self.above_mark()?)),
            0x85..=0x87 => Value::List(shared(self.last(usize::from(operation) - 0x84)?)),
            b'a' | b's' | b'e' | b'u' => {
                let values = match operation {
                    b'a' => self.last(1)?,
                    b's' => self.last(2)?,
                    _ => self.above_mark()?,
                };
                return self.add(values);
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                Value::Bytes([module, name].join(&b'.').into())
            }
            0x93 => match &self.last(2)?[..] {
                [Value::Bytes(module), Value::Bytes(name)] => {
                    Value::Bytes([&**module, &**name].join(&b'.').into())
                }
                _ => return Err("a name is no text".into()),
            },
            // A call, or a new object: function and arguments.
            b'R' | 0x81 => Value::Object(shared(self.last(2)?)),
            b'b' => {
                let state = self.pop()?;
                match self.stack.last() {
                    Some(Value::Object(parts)) => parts.borrow_mut().push(state),
                    _ => return Err("it sets the state of a value that is no object".into()),
                }
                return Ok(());
            }
            b'q' | b'r' => {
                let at = self.whole(if operation == b'q' { 1 } else { 4 })?;
                return self.remember(at);
            }
            0x94 => return self.remember(self.memo.len()),
            b'h' | b'j' => {
                let at = self.whole(if operation == b'h' { 1 } else { 4 })?;
                self.memo.get(at).cloned().ok_or("it recalls a value that was never stored")?
            }
            other => return Err(format!("step {other:#04x} is not understood")),
        };
        self.stack.push(value);
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn yaw(name: &str, content: &[u8]) -> Result<f64, String> {
        let folder = tempfile::tempdir().expect("temporary folder");
        let path = folder.path().join(name);
        std::fs::write(&path, content).expect("write");
        yaw_degrees(&path).map_err(|e| e.to_string())
    }

    /// Dictionaries of NumPy arrays from Python's `pickle`, with `global_orient` = [[0.25, −1.5, 0.125]].
    const PICKLES: [&[u8]; 4] = [
        include_bytes!("../tests/smplx/protocol2.pkl"),
        include_bytes!("../tests/smplx/protocol4.pkl"),
        include_bytes!("../tests/smplx/big_endian.pkl"),
        // Protocol 5 of NumPy 2.
        include_bytes!("../tests/smplx/numpy2.pkl"),
    ];

    #[test]
    fn pickles_of_every_protocol_are_read_without_running_them() {
        for pickle in PICKLES {
            assert_eq!(yaw("a.pkl", pickle), Ok((-1.5_f64).to_degrees()));
        }
    }

    #[test]
    fn broken_pickles_are_refused() {
        let message = |content: &[u8]| yaw("a.pkl", content).expect_err("refused");
        for pickle in PICKLES {
            for length in 0..pickle.len() {
                message(&pickle[..length]);
            }
        }
        assert!(message(b"\x80\x02}.").ends_with("`global_orient` is missing"));
        assert!(message(b"t.").ends_with("a mark is missing"));
        assert!(message(&[b'('; 20_000]).contains("more than 10000 steps"));
        assert!(message(b"\x80\x04\x95").ends_with("it is cut off"));
        // A dictionary that contains itself.
        assert!(message(b"}q\x00X\x0d\x00\x00\x00global_orienth\x00s.").contains("no array of numbers"));
    }

    #[test]
    fn json_is_read_too() {
        assert_eq!(yaw("a.json", br#"{"global_orient": [[0.1, 1.5707963267948966, 0]]}"#), Ok(90.0));
        let wrong = yaw("a.json", br#"{"global_orient": [0, 1]}"#).expect_err("two numbers");
        assert!(wrong.ends_with("`global_orient` is [0.0, 1.0], expected three numbers"), "{wrong}");
    }
}
