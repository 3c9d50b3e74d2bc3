//! The direction that a scan faces, from its SMPL-X parameters: THuman's `smplx_param.pkl`.
//!
//! A pickle is a program for a stack machine that may call any function. The machine of this file calls no function. It
//! stores calls as data, and recognises the calls that make NumPy's arrays.

use std::cell::RefCell;
use std::path::Path;
use std::rc::Rc;

use snapsnap_base::{FileError, file};

/// Largest file that is read, in bytes. Parameters take a few kilobytes.
const MAX_BYTES: u64 = 16 << 20;
/// Largest number of operations of a pickle. Parameters take a few hundred.
const MAX_OPERATIONS: usize = 10_000;
/// The parameter of the body's orientation: an axis times an angle in radians.
const ORIENTATION: &str = "global_orient";

/// Angle in degrees, around +y, from +z to the direction that the body faces. As in the published code, `global_orient`
/// is treated as a pure rotation around y by its second component (docs/method.md, "Cameras").
///
/// # Errors
/// [`FileError`] for a file that cannot be read or has no orientation of three finite numbers.
pub fn yaw_degrees(path: &Path) -> Result<f64, FileError> {
    let bytes = file::read(path, MAX_BYTES).map_err(FileError::read(path))?;
    let orientation = orientation(&bytes)
        .map_err(|e| FileError::unsuitable(path, format!("is no file of SMPL-X parameters: {e}")))?;
    match orientation[..] {
        [x, y, z] if [x, y, z].iter().all(|v| v.is_finite()) => Ok(y.to_degrees()),
        _ => {
            let message = format!("`{ORIENTATION}` is {orientation:?}, expected three numbers");
            Err(FileError::unsuitable(path, message))
        }
    }
}

fn orientation(bytes: &[u8]) -> Result<Vec<f64>, String> {
    let Value::Parts(entries) = unpickle(bytes)? else { return Err("it holds no dictionary".into()) };
    let entries = entries.borrow();
    let value = entries
        .chunks_exact(2)
        .find(|pair| matches!(&pair[0], Value::Bytes(key) if **key == *ORIENTATION.as_bytes()));
    let value = &value.ok_or_else(|| format!("`{ORIENTATION}` is missing"))?[1];
    numbers(value).ok_or_else(|| format!("`{ORIENTATION}` is no array of numbers"))
}

/// A value of a pickle.
#[derive(Clone, Debug)]
enum Value {
    /// A number, a truth value or `None`.
    Other,
    Mark,
    /// Bytes, or text in UTF-8. Strings of Python 2 may be either.
    Bytes(Rc<[u8]>),
    /// The items of a list or a tuple, the keys and values of a dictionary in turn, or the function and the arguments of
    /// a call and the state that is set afterwards. Shared, as in Python.
    Parts(Rc<RefCell<Vec<Value>>>),
}

fn parts(values: Vec<Value>) -> Value {
    Value::Parts(Rc::new(RefCell::new(values)))
}

/// The numbers of a NumPy array, in order.
fn numbers(array: &Value) -> Option<Vec<f64>> {
    let Value::Parts(call) = array else { return None };
    let call = call.borrow();
    let Some(Value::Parts(last)) = call.last() else { return None };
    let last = last.borrow();
    let (dtype, bytes) = match last.as_slice() {
        // The state (version, shape, dtype, is_fortran, bytes) of _reconstruct(…), or the arguments of NumPy 2's
        // _frombuffer(bytes, dtype, shape, order).
        [_, _, Value::Parts(dtype), _, bytes] | [bytes, Value::Parts(dtype), _, _] => {
            (dtype.borrow(), raw(bytes)?)
        }
        _ => return None,
    };
    let Some(Value::Parts(arguments)) = dtype.get(1) else { return None };
    let arguments = arguments.borrow();
    let Some(Value::Bytes(kind)) = arguments.first() else { return None };
    let is_big_endian = matches!(dtype.get(2), Some(Value::Parts(state))
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

/// The bytes of a value. In protocol 2, Python 3 writes bytes as a call that encodes text as Latin-1.
fn raw(value: &Value) -> Option<Rc<[u8]>> {
    let call = match value {
        Value::Bytes(bytes) => return Some(bytes.clone()),
        Value::Parts(call) => call.borrow(),
        _ => return None,
    };
    let [Value::Bytes(name), Value::Parts(arguments)] = call.as_slice() else { return None };
    let arguments = arguments.borrow();
    let Some(Value::Bytes(text)) = arguments.first().filter(|_| **name == *b"_codecs.encode") else {
        return None;
    };
    let text = std::str::from_utf8(text).ok()?;
    text.chars().map(|c| u8::try_from(u32::from(c)).ok()).collect()
}

/// Runs a pickle of protocol 2 to 5 with the operations of SMPL-X parameters.
fn unpickle(bytes: &[u8]) -> Result<Value, String> {
    let mut machine = Machine { rest: bytes, stack: Vec::new(), memo: Vec::new() };
    for _ in 0..MAX_OPERATIONS {
        let operation = machine.take(1)?[0];
        if operation == b'.' {
            return machine.top();
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

    fn top(&self) -> Result<Value, String> {
        self.stack.last().cloned().ok_or_else(|| "it takes from an empty stack".into())
    }

    /// Adds to the list, the dictionary or the call on top.
    fn add(&mut self, values: Vec<Value>) -> Result<(), String> {
        let Value::Parts(parts) = self.top()? else {
            return Err("it adds to a value that is no container".into());
        };
        parts.borrow_mut().extend(values);
        Ok(())
    }

    fn remember(&mut self, at: usize) -> Result<(), String> {
        let value = self.top()?;
        if at > MAX_OPERATIONS {
            return Err("its memo is too large".into());
        }
        if self.memo.len() <= at {
            self.memo.resize(at + 1, Value::Other);
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
            b'0' => return self.last(1).map(drop),
            b'N' | 0x88 | 0x89 => Value::Other,
            b'K' | b'M' | b'J' | b'G' | 0x8a => {
                let length = match operation {
                    b'K' => 1,
                    b'M' => 2,
                    b'J' => 4,
                    b'G' => 8,
                    _ => self.whole(1)?,
                };
                self.take(length)?;
                Value::Other
            }
            b'X' | b'T' | b'B' | 0x8c | b'U' | b'C' | 0x8d | 0x8e | 0x96 => {
                let length = self.whole(match operation {
                    b'X' | b'T' | b'B' => 4,
                    0x8c | b'U' | b'C' => 1,
                    _ => 8,
                })?;
                Value::Bytes(self.take(length)?.into())
            }
            b'}' | b']' | b')' => parts(Vec::new()),
            b't' => parts(self.above_mark()?),
            0x85..=0x87 => parts(self.last(usize::from(operation) - 0x84)?),
            b'a' | b'b' | b's' | b'e' | b'u' => {
                let values = match operation {
                    b'a' | b'b' => self.last(1)?,
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
            b'R' | 0x81 => parts(self.last(2)?),
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
        let mut number = PICKLES[1].to_vec();
        let at = number.windows(4).position(|bytes| bytes == 0.25_f32.to_le_bytes()).expect("is there");
        number[at..at + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert!(message(&number).ends_with("`global_orient` is [NaN, -1.5, 0.125], expected three numbers"));
        // A dictionary that contains itself.
        assert!(message(b"}q\x00X\x0d\x00\x00\x00global_orienth\x00s.").contains("no array of numbers"));
    }
}
