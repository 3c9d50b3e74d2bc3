//! PyTorch's checkpoints, written as `torch.save` does: a pickle of tensors that lie one after another in one storage.

use std::io::{Cursor, Write};

use snapsnap_net::weights::Source;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

/// All tensors of `source` as a state dict.
pub fn checkpoint(source: &Source) -> Vec<u8> {
    let mut storage = Vec::new();
    let tensors: Vec<(&str, &[usize], Vec<f32>)> = source
        .tensors()
        .iter()
        .map(|(name, entry)| (name.as_str(), entry.shape.as_slice(), source.read_f32(name).expect("floats")))
        .collect();
    let all: usize = tensors.iter().map(|(_, _, values)| values.len()).sum();
    // Protocol 2, a dictionary, all pairs at once.
    let mut pickle = b"\x80\x02}(".to_vec();
    let mut offset = 0;
    for (name, shape, values) in &tensors {
        text(&mut pickle, name);
        pickle.extend(b"ctorch._utils\n_rebuild_tensor_v2\n((");
        text(&mut pickle, "storage");
        pickle.extend(b"ctorch\nFloatStorage\n");
        text(&mut pickle, "0");
        text(&mut pickle, "cpu");
        number(&mut pickle, all);
        // The storage by its persistent name.
        pickle.extend(b"tQ");
        number(&mut pickle, offset);
        let strides = (0..shape.len()).map(|axis| shape[axis + 1..].iter().product());
        for numbers in [shape.to_vec(), strides.collect()] {
            pickle.push(b'(');
            numbers.into_iter().for_each(|n: usize| number(&mut pickle, n));
            pickle.push(b't');
        }
        // No gradient, no hooks; then the call.
        pickle.extend(b"\x89ccollections\nOrderedDict\n)RtR");
        offset += values.len();
        storage.extend(values.iter().flat_map(|value| value.to_le_bytes()));
    }
    pickle.extend(b"u.");
    let mut archive = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
    let version = b"3\n".to_vec();
    for (name, content) in [("data.pkl", pickle), ("data/0", storage), ("version", version)] {
        archive.start_file(format!("archive/{name}"), options).expect("a new entry");
        archive.write_all(&content).expect("written to memory");
    }
    archive.finish().expect("written to memory").into_inner()
}

fn text(pickle: &mut Vec<u8>, text: &str) {
    pickle.push(b'X');
    pickle.extend((text.len() as u32).to_le_bytes());
    pickle.extend(text.bytes());
}

fn number(pickle: &mut Vec<u8>, number: usize) {
    pickle.push(b'J');
    pickle.extend((number as u32).to_le_bytes());
}
