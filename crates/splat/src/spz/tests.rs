use std::fs;
use std::path::PathBuf;

use serde_json::Value;

use super::*;

/// Files of Niantic's library, made by docs/spz_reference.mjs, with their input and their decoded values.
fn reference(name: &str) -> (Vec<u8>, Value) {
    let folder = PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/data/spz"));
    let bytes = fs::read(folder.join(format!("{name}.spz"))).expect("a file");
    let text = fs::read_to_string(folder.join(format!("{name}.json"))).unwrap_or_else(|_| "null".into());
    (bytes, serde_json::from_str(&text).expect("JSON"))
}

/// Niantic's lists as a [`Stored`].
fn stored(values: &Value, degree: u64) -> Stored {
    let list = |key: &str| -> Vec<f32> {
        values[key].as_array().expect("a list").iter().map(|v| v.as_f64().expect("a number") as f32).collect()
    };
    let column = |all: &[f32], width: usize, at: usize| -> Vec<f32> {
        all.iter().skip(at).step_by(width).copied().collect()
    };
    let [positions, rotations, scales, colors, bands] =
        ["positions", "rotations", "scales", "colors", "sh"].map(list);
    let mut columns: Vec<Vec<f32>> = (0..3).map(|axis| column(&positions, 3, axis)).collect();
    columns.extend([3, 0, 1, 2].map(|at| column(&rotations, 4, at)));
    columns.extend((0..3).map(|axis| column(&scales, 3, axis)));
    columns.push(list("alphas"));
    columns.extend((0..3).map(|channel| column(&colors, 3, channel)));
    let coefficients = COEFFICIENTS[degree as usize];
    for channel in 0..3 {
        let bands = |band: usize| column(&bands, 3 * (coefficients - 1), 3 * band + channel);
        columns.extend((0..coefficients - 1).map(bands));
    }
    Stored { coefficients, columns }
}

fn content(gzip: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::new();
    GzDecoder::new(gzip).read_to_end(&mut bytes).expect("a gzip stream");
    bytes
}

/// The bytes of a file.
fn written(stored: &Stored) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(stored, &mut bytes).expect("written");
    bytes
}

/// The Gaussians of a file of `stored`.
fn again(stored: &Stored) -> Stored {
    let bytes = written(stored);
    read(&bytes[..], bytes.len() as u64).expect("was written just now")
}

#[test]
fn niantics_files_are_read_as_niantics_library_reads_them() {
    for name in ["v2_degree0", "v3_degree0", "v3_degree3"] {
        let (bytes, values) = reference(name);
        let degree = values["degree"].as_u64().expect("a degree");
        let expected = stored(&values["output"], degree);
        let found = read(&bytes[..], bytes.len() as u64).expect(name);
        assert_eq!(found.degree() as u64, degree);
        assert_eq!(found.columns.len(), expected.columns.len());
        for (row, (found, expected)) in found.columns.iter().zip(&expected.columns).enumerate() {
            for (a, b) in found.iter().zip(expected) {
                assert!((a - b).abs() < 2e-5, "{name}, column {row}: {a}, expected {b}");
            }
        }
    }
}

#[test]
fn what_is_written_is_what_niantics_library_writes() {
    for name in ["v3_degree0", "v3_degree3"] {
        let (expected, values) = reference(name);
        let stored = stored(&values["input"], values["degree"].as_u64().expect("a degree"));
        let (found, expected) = (content(&written(&stored)), content(&expected));
        assert_eq!(found.len(), expected.len(), "{name}");
        let other = found.iter().zip(&expected).filter(|(a, b)| a.abs_diff(**b) > 0).count();
        // Rounding in f32 and f64 differs where a value lies in the middle of two steps.
        assert!(other * 100 <= found.len(), "{name}: {other} of {} bytes differ", found.len());
    }
}

#[test]
fn what_is_no_spz_or_a_damaged_one_is_refused() {
    let problem = |bytes: &[u8]| match read(bytes, bytes.len() as u64).expect_err("was read") {
        Problem::Content(problem) => problem,
        Problem::Io(e) => panic!("{e}"),
    };
    let (good, _) = reference("v3_degree3");
    let packed = |content: &[u8]| {
        let mut out = GzEncoder::new(Vec::new(), Compression::fast());
        out.write_all(content).expect("packed");
        out.finish().expect("packed")
    };
    let changed = |at: usize, value: u8| {
        let mut bytes = content(&good);
        bytes[at] = value;
        packed(&bytes)
    };
    assert!(problem(&packed(b"hello, this is a text")).contains("no SPZ"));
    assert!(problem(&changed(4, 9)).contains("version 9"));
    assert!(problem(&changed(11, 0x7f)).contains("at most"));
    assert!(problem(&changed(12, 5)).contains("degree 5"));
    assert!(problem(&changed(13, 25)).contains("25 fractional bits"));
    assert!(problem(&changed(8, 25)).contains("too early"));
    assert!(problem(&GZIP).contains("gzip stream is cut"));
    let mut sum = good.clone();
    let at = sum.len() - 6;
    sum[at] ^= 1;
    assert!(problem(&sum).contains("damaged"));
}

#[test]
fn far_away_places_get_coarser_steps_and_that_is_told() {
    let mut values = stored(&reference("v3_degree0").1["input"], 0);
    values.columns[0][0] = -70_000.0;
    let found = again(&values);
    assert!((found.columns[0][0] + 70_000.0).abs() < 0.01);
    assert!((found.columns[1][0] - values.columns[1][0]).abs() <= 0.5 / 64.0);
    let told = losses(&values);
    assert!(told.len() == 1 && told[0].contains("steps of 15.6 mm, since one lies 70000 m"), "{told:?}");
    values.columns[0][0] = 1e7;
    assert!(check(&values).expect_err("too far").contains("8,388 km"));
}

#[test]
fn what_lies_beyond_the_range_is_counted() {
    let mut values = stored(&reference("v3_degree3").1["input"], 3);
    assert_eq!(losses(&values), Vec::<String>::new());
    values.columns[7][0] = 6.0;
    values.columns[9][0] = 7.0;
    values.columns[8][3] = 6.0;
    // A scale below the range is no loss.
    values.columns[7][1] = -23.0;
    values.columns[11][2] = -4.0;
    // Values at the ends of the range are no loss.
    values.columns[12][0] = -0.5 / COLOR_SCALE;
    values.columns[12][1] = 0.5 / COLOR_SCALE;
    values.columns[9][4] = 255.0 / 16.0 - 10.0;
    values.columns[14][5] = 1.5;
    let told = losses(&values);
    let expected =
        ["2 Gaussians have scales", "1 Gaussians have colours", "1 Gaussians have spherical harmonics"];
    assert_eq!(told.len(), expected.len(), "{told:?}");
    for (told, expected) in told.iter().zip(expected) {
        assert!(told.starts_with(expected), "{told}");
    }
    // Values beyond the range are clamped.
    let found = again(&values);
    assert_eq!(found.columns[7][0], 255.0 / 16.0 - 10.0);
    assert_eq!(losses(&found), Vec::<String>::new());
}
