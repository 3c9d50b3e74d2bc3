//! Importing, exporting and refusing checkpoints.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

use safetensors::Dtype;
use safetensors::tensor::TensorView;
use snapsnap_base::config::Schema;
use snapsnap_net::config::{Config, Precision};
use snapsnap_net::weights::{
    Entry, ImportOptions, Source, WeightFile, WeightsError, export, import, init, schema,
};
use snapsnap_tests::workplace::Workplace;
use snapsnap_tests::{FIXTURE_VALUES, data, fixture, root, set_tensor};

const OPTIONS: ImportOptions = ImportOptions { fill: None, seed: 3, float: Precision::F32 };

fn tiny() -> Config {
    Config::from_file(&root().join("configs/tiny.toml"), &[]).expect("tiny.toml")
}

type Tensors = BTreeMap<String, (Dtype, Vec<usize>, Vec<u8>)>;

/// All tensors of a file, as f32 bytes.
fn read(path: &Path) -> Tensors {
    let source = Source::open(path).expect("readable");
    let value =
        |name: &String| source.read_f32(name).expect("float").iter().flat_map(|v| v.to_le_bytes()).collect();
    let entry = |(name, e): (&String, &Entry)| (name.clone(), (Dtype::F32, e.shape.clone(), value(name)));
    source.tensors().iter().map(entry).collect()
}

fn write(tensors: &Tensors, path: &Path) {
    let views = tensors.iter().map(|(name, (dtype, shape, bytes))| {
        (name.as_str(), TensorView::new(*dtype, shape.clone(), bytes).expect("consistent"))
    });
    std::fs::write(path, safetensors::serialize(views, None).expect("valid")).expect("written");
}

/// A folder with random tiny weights in it.
fn place() -> Workplace {
    let place = Workplace::empty();
    init(&tiny(), 1, &place.path("ours.safetensors"), &|_, _| ()).expect("written");
    place
}

/// The random weights, changed.
fn changed(place: &Workplace, change: impl FnOnce(&mut Tensors)) -> Tensors {
    let mut tensors = read(&place.path("ours.safetensors"));
    change(&mut tensors);
    tensors
}

/// What an import makes of these tensors, with its notes.
fn import_here(place: &Workplace, tensors: &Tensors) -> Result<(Tensors, Vec<String>), WeightsError> {
    let (from, to) = (place.path("in.safetensors"), place.path("out.safetensors"));
    write(tensors, &from);
    let _ = std::fs::remove_file(&to);
    let result = import(&[from], &tiny(), OPTIONS, &to, &|_, _| ());
    assert_eq!(result.is_ok(), to.exists(), "a file is left exactly if the import succeeds");
    result.map(|report| (read(&to), report.notes))
}

/// The problems for which changed weights are refused.
fn problems(place: &Workplace, change: impl FnOnce(&mut Tensors)) -> Vec<String> {
    match import_here(place, &changed(place, change)) {
        Err(WeightsError::Tensors { problems, .. }) => problems,
        other => panic!("expected a list of problems, got {other:?}"),
    }
}

const QKV: &str = "dust3r.enc_blocks.1.attn.qkv.weight";

#[test]
fn the_authors_pickles_hold_what_their_safetensors_hold() {
    let place = place();
    let ours = place.path("imported.safetensors");
    let sources = ["stage1.pth", "stage2.pth"].map(|name| fixture("pipeline").join(name));
    let report = import(&sources, &tiny(), OPTIONS, &ours, &|_, _| ()).expect("imports");
    let imported = read(&ours);
    // The first values of each tensor.
    let direct = read(&fixture("pipeline/weights_start.safetensors"));
    assert_eq!(report.tensors, imported.len());
    let mut compared = 0;
    for (name, (_, _, start)) in &direct {
        let (_, _, bytes) = &imported[&format!("dust3r.{name}")];
        assert!(start.len() >= bytes.len().min(4 * FIXTURE_VALUES) && bytes.starts_with(start), "{name}");
        compared += 1;
    }
    assert_eq!(compared, imported.keys().filter(|k| k.starts_with("dust3r.")).count());
    let delta = f32::from_le_bytes(imported["scale"].2.clone().try_into().expect("one f32"));
    assert!((delta - 1.7).abs() < 1e-6, "{delta}");
}

#[test]
fn export_gives_every_name_of_the_authors_state_dicts() {
    let place = place();
    let (ours, exported) = (place.path("imported.safetensors"), place.path("exported.safetensors"));
    let sources = ["stage1.pth", "stage2.pth"].map(|name| data("pipeline").join(name));
    import(&sources, &tiny(), OPTIONS, &ours, &|_, _| ()).expect("imports");
    export(&ours, &exported, &|_, _| ()).expect("exports");
    let exported = read(&exported);
    let authors: Tensors = sources.iter().flat_map(|path| read(path)).collect();
    let names = |tensors: &Tensors| tensors.keys().cloned().collect::<Vec<_>>();
    assert_eq!(names(&exported), names(&authors));
    assert_eq!(exported, authors);
}

#[test]
fn a_dust3r_file_gets_delta_and_side_heads_and_says_so() {
    let place = place();
    let (from, to) = (place.path("dust3r.safetensors"), place.path("out.safetensors"));
    let of_dust3r = |(name, tensor): (&String, &(Dtype, Vec<usize>, Vec<u8>))| {
        let bare =
            name.strip_prefix("dust3r.").filter(|bare| !bare.contains("head3") && !bare.contains("head4"));
        bare.map(|bare| (bare.to_owned(), tensor.clone()))
    };
    let mut dust3r: Tensors = read(&fixture("pipeline/stage1.pth")).iter().filter_map(of_dust3r).collect();
    dust3r.insert("mask_token".into(), (Dtype::F32, vec![1], vec![0; 4]));
    write(&dust3r, &from);
    let options = ImportOptions { seed: 5, ..OPTIONS };
    let report = import(std::slice::from_ref(&from), &tiny(), options, &to, &|_, _| ()).expect("imports");
    let (seeded, notes) = (read(&to), report.notes.join("\n"));
    assert!(notes.contains("head 3 is in no file: drawn from seed 5") && notes.contains("δ"), "{notes}");
    assert!(notes.contains("mask_token"), "{notes}");
    let weight = |k: usize| &seeded[&format!("dust3r.downstream_head{k}.dpt.head.2.weight")];
    assert_ne!(weight(3), weight(1));
    let Err(e) = WeightFile::open(&to, None).expect("opens").require(schema::Part::Regressor) else {
        panic!("a file without a regressor is complete");
    };
    assert!(e.to_string().contains("stage-2"), "{e}");
}

#[test]
fn a_croco_file_gives_both_decoders_and_no_heads() {
    let place = place();
    let croco = changed(&place, |t| {
        t.retain(|k, _| {
            k.starts_with("dust3r.") && !k.contains("dec_blocks2") && !k.contains("downstream_head")
        });
        *t = t.iter().map(|(k, v)| (k.trim_start_matches("dust3r.").to_owned(), v.clone())).collect();
        t.insert("prediction_head.bias".into(), (Dtype::F32, vec![2], vec![0; 8]));
    });
    let (imported, notes) = import_here(&place, &croco).expect("imports");
    let weight = |stack: &str| imported[&format!("dust3r.{stack}.2.cross_attn.projk.weight")].clone();
    assert_eq!(weight("dec_blocks"), weight("dec_blocks2"));
    let notes = notes.join("\n");
    assert!(notes.contains("dec_blocks2") && notes.contains("head 1 is in no file"), "{notes}");
    assert!(notes.contains("prediction_head.bias"), "{notes}");
}

#[test]
fn another_file_gives_the_tensors_that_are_in_none_of_the_first() {
    let place = place();
    let [part, all, to] = ["part", "ours", "to"].map(|name| place.path(&format!("{name}.safetensors")));
    let mut tensors = read(&all);
    let own = |name: &str| name.contains("enc_blocks") || name == "scale";
    tensors.retain(|name, _| own(name));
    for (_, _, bytes) in tensors.values_mut() {
        bytes.chunks_exact_mut(4).for_each(|value| value.copy_from_slice(&0.25_f32.to_le_bytes()));
    }
    write(&tensors, &part);
    let with = |fill| {
        let options = ImportOptions { fill, ..OPTIONS };
        import(std::slice::from_ref(&part), &tiny(), options, &to, &|_, _| ())
    };
    assert!(with(None).expect_err("a part").to_string().contains("missing: dust3r."));
    assert!(!to.exists());
    let report = with(Some(all.as_path())).expect("imports");
    let (expected, got) = (read(&all), read(&to));
    assert_eq!(report.tensors, got.len());
    let given = |name: &String| if own(name) { &tensors[name] } else { &expected[name] };
    assert!(got.iter().all(|(name, tensor)| tensor == given(name)));
    assert!(got.keys().any(|name| own(name)) && got.keys().any(|name| !own(name)));
    let count = expected.len() - tensors.len();
    assert!(
        report.notes.join("\n").contains(&format!("{count} tensors are in none of the others: from ")),
        "{:?}",
        report.notes
    );
    assert!(with(Some(&place.path("absent"))).is_err());
}

#[test]
fn half_precision_files_load() {
    let place = place();
    let bf16 = changed(&place, |t| {
        for (dtype, _, bytes) in t.values_mut() {
            *dtype = Dtype::BF16;
            *bytes = bytes.chunks_exact(4).flat_map(|b| [b[2], b[3]]).collect();
        }
    });
    let (imported, _) = import_here(&place, &bf16).expect("imports");
    for (name, (_, _, bytes)) in &imported {
        assert!(
            bytes.chunks_exact(4).zip(bf16[name].2.chunks_exact(2)).all(|(w, n)| w == [0, 0, n[0], n[1]]),
            "{name}"
        );
    }
    // 1.5 and −2⁻¹⁴ are exact in f16.
    let f16 = changed(&place, |t| {
        *t.get_mut("gs_conv.bias").expect("there") =
            (Dtype::F16, vec![14], [0x00, 0x3e, 0x00, 0x84].repeat(7));
    });
    let (imported, _) = import_here(&place, &f16).expect("imports");
    let expected: Vec<u8> =
        [1.5_f32, -(2.0_f32.powi(-14))].repeat(7).iter().flat_map(|v| v.to_le_bytes()).collect();
    assert_eq!(imported["gs_conv.bias"].2, expected);
}

#[test]
fn missing_unused_and_misshaped_tensors_are_all_named() {
    let place = place();
    let problems = problems(&place, |t| {
        t.remove("dust3r.enc_norm.bias");
        t.insert("dust3r.extra".into(), (Dtype::F32, vec![1], vec![0; 4]));
        t.get_mut(QKV).expect("there").1 = vec![64, 192];
        t.get_mut("dust3r.dec_norm.weight").expect("there").0 = Dtype::I32;
    });
    let all = problems.join("\n");
    assert_eq!(problems.len(), 4, "{all}");
    assert!(all.contains("missing: dust3r.enc_norm.bias [64]"), "{all}");
    assert!(all.contains("not part of the configured networks: dust3r.extra"), "{all}");
    assert!(all.contains(QKV) && all.contains("[64, 192]") && all.contains("[192, 64]"), "{all}");
    assert!(all.contains("dust3r.dec_norm.weight is i32"), "{all}");
}

/// PyTorch's wrappers of networks change names, not tensors.
#[test]
fn wrapped_names_are_the_names_inside() {
    let place = place();
    let (expected, _) = import_here(&place, &changed(&place, |_| ())).expect("imports");
    for prefix in
        ["module.", "_orig_mod.", "state_dict.", "model_state_dict.module.", "network._orig_mod.module."]
    {
        let renamed =
            |t: &mut Tensors| *t = t.iter().map(|(k, v)| (format!("{prefix}{k}"), v.clone())).collect();
        let (imported, _) = import_here(&place, &changed(&place, renamed)).expect(prefix);
        assert!(imported == expected, "{prefix}");
    }
    // A type that is not read is named once for all tensors.
    let doubled = |t: &mut Tensors| {
        for (dtype, _, bytes) in t.values_mut() {
            (*dtype, *bytes) = (Dtype::F64, bytes.repeat(2));
        }
    };
    let said = import_here(&place, &changed(&place, doubled)).map(|_| ()).expect_err("refused").to_string();
    assert!(said.contains("is f64") && said.contains("more") && said.lines().count() == 2, "{said}");
}

#[test]
fn every_tensor_with_a_value_that_is_not_finite_is_named() {
    let place = place();
    let problems = problems(&place, |t| {
        t.get_mut(QKV).expect("there").2[..4].copy_from_slice(&f32::NAN.to_le_bytes());
        t.get_mut("gs_conv.bias").expect("there").2[..4].copy_from_slice(&f32::INFINITY.to_le_bytes());
    });
    assert_eq!(problems.len(), 2, "{problems:?}");
    assert!(problems[0].contains(QKV) && problems[1].contains("gs_conv.bias"), "{problems:?}");
}

/// An export refuses values that an import refuses.
#[test]
fn exports_refuse_values_that_are_not_finite() {
    let place = place();
    let [whole, broken, out] = ["ours.safetensors", "broken", "out"].map(|name| place.path(name));
    std::fs::copy(&whole, &broken).expect("copied");
    set_tensor(&broken, "gs_conv.bias", &[f32::NAN]);
    export(&whole, &out, &|_, _| ()).expect("exports");
    let good = std::fs::read(&out).expect("read");
    let message = export(&broken, &out, &|_, _| ()).expect_err("refuses").to_string();
    assert!(message.contains("not finite: ") && message.contains("(1 of "), "{message}");
    assert!(std::fs::read(&out).expect("read") == good, "the old file stays");
}

#[test]
fn one_name_of_an_alias_is_enough_and_two_must_agree() {
    let place = place();
    let name = "dust3r.downstream_head1.dpt.scratch.layer2_rn.weight";
    let alias = "dust3r.downstream_head1.dpt.scratch.layer_rn.1.weight";
    let agreeing = changed(&place, |t| {
        let value = t[name].clone();
        t.insert(alias.into(), value);
    });
    assert!(import_here(&place, &agreeing).is_ok());
    let problems = problems(&place, |t| {
        let mut value = t[name].clone();
        value.2[0] ^= 1;
        t.insert(alias.into(), value);
    });
    assert!(problems.len() == 1 && problems[0].contains("layer_rn.1"), "{problems:?}");
    let renamed = changed(&place, |t| {
        let value = t.remove(name).expect("there");
        t.insert(alias.into(), value);
    });
    let (imported, _) = import_here(&place, &renamed).expect("imports");
    assert_eq!(imported, read(&place.path("ours.safetensors")));
}

#[test]
fn damaged_files_are_refused_not_misread() {
    let place = place();
    let path = place.path("damaged.safetensors");
    let good = place.read("ours.safetensors");
    let mut header = good.clone();
    header[0..8].copy_from_slice(&u64::MAX.to_le_bytes());
    let mut text = good.clone();
    text[20] = b'}';
    let cases: HashMap<&str, &[u8]> = HashMap::from([
        ("truncated", &good[..good.len() - 7]),
        ("header only", &good[..100]),
        ("empty", &[]),
        ("absurd header length", &header),
        ("damaged header", &text),
        ("text", b"these are no weights"),
    ]);
    for (case, bytes) in cases {
        std::fs::write(&path, bytes).expect("written");
        assert!(matches!(Source::open(&path), Err(WeightsError::File(_))), "{case}");
    }
    let pickle = std::fs::read(data("pipeline").join("stage2.pth")).expect("read");
    let path = place.path("damaged.pth");
    for keep in [10, pickle.len() / 2, pickle.len() - 30] {
        std::fs::write(&path, &pickle[..keep]).expect("written");
        assert!(matches!(Source::open(&path), Err(WeightsError::File(_))), "pickle cut at {keep}");
    }
}

#[test]
fn the_schema_is_the_full_size_state_dict() {
    let text = std::fs::read_to_string(fixture("full_size_keys.json")).expect("read");
    let keys: BTreeMap<String, Vec<usize>> = serde_json::from_str(&text).expect("JSON");
    let ours: BTreeMap<String, Vec<usize>> =
        schema::tensors(&Config::default()).into_iter().map(|t| (t.name, t.shape)).collect();
    let (mut aliases, mut checked) = (0, 0);
    for (key, shape) in keys.iter().filter(|(key, _)| *key != "mask_token") {
        if key.contains("scratch.layer_rn.") {
            aliases += 1;
            continue;
        }
        assert_eq!(ours.get(&format!("dust3r.{key}")), Some(shape), "{key}");
        checked += 1;
    }
    assert_eq!(checked, ours.keys().filter(|k| k.starts_with("dust3r.")).count());
    assert_eq!(aliases, 16);
}
