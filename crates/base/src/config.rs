//! TOML configs: a file, the file that it `extends`, and assignments on top.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

use serde::Serialize;
use serde::de::DeserializeOwned;
use toml::{Table, Value};

use crate::{FileError, file};

/// Longest config that is read, in bytes.
const MAX_BYTES: u64 = 1 << 20;
/// Longest chain of files that extend one another.
const MAX_CHAIN: usize = 8;
/// The key that names the file which a config extends. Its path is relative to the config's own folder.
const EXTENDS: &str = "extends";

/// A config that cannot be used.
#[derive(Debug, thiserror::Error)]
#[allow(missing_docs, reason = "the names say it")]
pub enum ConfigError {
    /// The file could not be read.
    #[error(transparent)]
    File(#[from] FileError),
    /// Not TOML, an unknown key, a wrong type or an unknown name. The parser's message has the line and the key.
    #[error("{origin}: {message}")]
    Syntax { origin: String, message: String },
    /// A value that is not allowed, by itself or together with the value of another key. The key is dotted; the message
    /// has the fault and the allowed values.
    #[error("{origin}: `{key}`: {message}")]
    Value { origin: String, key: String, message: String },
}

/// The type of a config. Every key has a default, so that a file may hold any part of it.
pub trait Schema: DeserializeOwned + Serialize {
    /// The dotted key of the first refused value, and the reason.
    fn refusal(&self) -> Option<(String, String)>;

    /// Reads and checks a file and the files that it extends; `overrides` are `a.b=c` assignments on top.
    ///
    /// # Errors
    /// [`ConfigError`], naming file, key and allowed values.
    fn from_file(path: &Path, overrides: &[String]) -> Result<Self, ConfigError> {
        let (table, origin) = layers::<Self>(path)?;
        build(table, origin, overrides)
    }

    /// Parses and checks TOML text that extends no file; `origin` names it in errors, `overrides` are `a.b=c`
    /// assignments on top.
    ///
    /// # Errors
    /// [`ConfigError`], naming origin, key and allowed values.
    fn from_toml(text: &str, origin: &str, overrides: &[String]) -> Result<Self, ConfigError> {
        let (table, extended) = layer::<Self>(text, origin)?;
        if extended.is_some() {
            return Err(syntax(origin, format!("`{EXTENDS}`: only a file can extend another")));
        }
        build(table, origin.to_owned(), overrides)
    }

    /// The config as TOML, with every key that has a value.
    ///
    /// # Panics
    /// For a type that TOML cannot represent.
    fn to_toml(&self) -> String {
        toml::to_string_pretty(self).expect("configs have only TOML types")
    }
}

/// The first key whose value is outside its range, and the message about it.
pub fn outside<T: PartialOrd + Display>(
    values: impl IntoIterator<Item = (&'static str, T, RangeInclusive<T>)>,
) -> Option<(&'static str, String)> {
    let (key, value, range) = values.into_iter().find(|(_, value, range)| !range.contains(value))?;
    Some((key, format!("is {value}, must be {} to {}", range.start(), range.end())))
}

/// The keys of a serialisable value, dotted, each with its value as TOML.
///
/// # Panics
/// For a value that is no TOML table.
pub fn keys(value: &impl Serialize) -> BTreeMap<String, String> {
    fn flatten(before: &str, table: &Table, keys: &mut BTreeMap<String, String>) {
        for (key, value) in table {
            match value {
                Value::Table(table) => flatten(&format!("{before}{key}."), table, keys),
                value => drop(keys.insert(format!("{before}{key}"), value.to_string())),
            }
        }
    }
    let mut keys = BTreeMap::new();
    flatten("", &Table::try_from(value).expect("a table"), &mut keys);
    keys
}

/// The keys that differ, each with a message that states both values.
pub fn differences(
    there: &BTreeMap<String, String>,
    wanted: &BTreeMap<String, String>,
) -> Vec<(String, String)> {
    let value = |of: &BTreeMap<String, String>, key: &str| of.get(key).map_or("unset".into(), String::clone);
    let all: BTreeSet<&String> = there.keys().chain(wanted.keys()).collect();
    let differing = all.into_iter().filter(|key| there.get(*key) != wanted.get(*key));
    let message =
        |key: &String| format!("`{key}` is {} there, not {}", value(there, key), value(wanted, key));
    differing.map(|key| (key.clone(), message(key))).collect()
}

/// Messages of the parser quote lines of the file, which may be of any length.
fn syntax(origin: &str, message: String) -> ConfigError {
    /// Characters that are shown of a line.
    const SHOWN: usize = 200;
    let short = |line: &str| match line.char_indices().nth(SHOWN) {
        Some((end, _)) => format!("{}…", &line[..end]),
        None => line.to_owned(),
    };
    let lines: Vec<String> = message.lines().map(short).collect();
    ConfigError::Syntax { origin: origin.to_owned(), message: lines.join("\n") }
}

/// The merged keys of a file and of the files that it extends, and the names of all these files for errors.
fn layers<T: Schema>(path: &Path) -> Result<(Table, String), ConfigError> {
    let mut chain: Vec<PathBuf> = Vec::new();
    let mut merged = Table::new();
    let mut next = Some(path.to_owned());
    while let Some(path) = next {
        let origin = path.display().to_string();
        if chain.len() == MAX_CHAIN {
            return Err(syntax(&origin, format!("more than {MAX_CHAIN} configs extend one another")));
        }
        let text = file::read_text(&path, MAX_BYTES).map_err(FileError::read(&path))?;
        let (below, extended) = layer::<T>(&text, &origin)?;
        next = extended.map(|name| path.parent().unwrap_or(Path::new("")).join(name));
        let above = std::mem::replace(&mut merged, below);
        merge(&mut merged, above);
        chain.push(path);
    }
    let names: Vec<String> = chain.iter().map(|path| path.display().to_string()).collect();
    Ok((merged, names.join(" extending ")))
}

/// The keys of one TOML text, whose names and types are checked, and the name of the file that it extends.
fn layer<T: Schema>(text: &str, origin: &str) -> Result<(Table, Option<String>), ConfigError> {
    let mut table: Table = toml::from_str(text).map_err(|e| syntax(origin, e.to_string()))?;
    let extended = match table.remove(EXTENDS) {
        None => None,
        Some(Value::String(name)) => Some(name),
        Some(other) => {
            return Err(syntax(origin, format!("`{EXTENDS}` is a {}, must be a path", other.type_str())));
        }
    };
    // serde would accept an array in place of a section.
    if let Some((key, value)) = table.iter().find(|(_, value)| !value.is_table()) {
        return Err(syntax(origin, format!("`{key}` is a {}, must be a section [{key}]", value.type_str())));
    }
    // Parsed from the text, so that messages have line numbers. `extends` is blanked out; it precedes all sections.
    let mut own: Vec<&str> = text.lines().collect();
    let first = own.iter_mut().find(|line| line.trim_start().starts_with(EXTENDS));
    if let Some(line) = first.filter(|_| extended.is_some()) {
        *line = "";
    }
    toml::from_str::<T>(&own.join("\n")).map_err(|e| syntax(origin, e.to_string()))?;
    Ok((table, extended))
}

/// Merges `above` into `below`, section by section and key by key; `above` wins.
fn merge(below: &mut Table, above: Table) {
    for (key, value) in above {
        match (below.get_mut(&key), value) {
            (Some(Value::Table(below)), Value::Table(above)) => merge(below, above),
            (_, value) => {
                below.insert(key, value);
            }
        }
    }
}

fn build<T: Schema>(mut table: Table, origin: String, overrides: &[String]) -> Result<T, ConfigError> {
    for assignment in overrides {
        assign(&mut table, assignment).map_err(|message| syntax(&format!("--set {assignment}"), message))?;
    }
    let origin = match overrides {
        [] => origin,
        _ => format!("{origin} with --set {}", overrides.join(" --set ")),
    };
    let config: T =
        Value::Table(table).try_into().map_err(|e: toml::de::Error| syntax(&origin, e.to_string()))?;
    match config.refusal() {
        Some((key, message)) => Err(ConfigError::Value { origin, key, message }),
        None => Ok(config),
    }
}

/// Applies `a.b=c`: `c` is a TOML value, or a bare word for a string.
fn assign(table: &mut Table, assignment: &str) -> Result<(), String> {
    let Some((key, value)) = assignment.split_once('=') else {
        return Err("expected SECTION.KEY=VALUE".into());
    };
    let parsed = toml::from_str::<Table>(&format!("v = {value}")).ok();
    let parsed = parsed.filter(|table| table.len() == 1).and_then(|mut table| table.remove("v"));
    let value = parsed.unwrap_or_else(|| Value::String(value.trim().to_owned()));
    let mut path: Vec<&str> = key.split('.').map(str::trim).collect();
    let last = path.pop().filter(|k| !k.is_empty()).ok_or("the key is empty")?;
    let mut at = table;
    for section in path {
        let entry = at.entry(section).or_insert_with(|| Value::Table(Table::new()));
        at = entry.as_table_mut().ok_or_else(|| format!("`{section}` is a value, not a section"))?;
    }
    at.insert(last.to_owned(), value);
    Ok(())
}

/// For `deserialize_with`: exactly four numbers. With an array type alone, a fifth number is dropped silently.
///
/// # Errors
/// The deserialiser's error, if there are not four numbers.
pub fn four<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<[usize; 4], D::Error> {
    let values: Vec<usize> = serde::Deserialize::deserialize(deserializer)?;
    let count = values.len();
    values.try_into().map_err(|_| serde::de::Error::custom(format!("{count} numbers, must be 4")))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use serde::Deserialize;

    use super::*;

    #[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Config {
        network: Network,
    }

    #[derive(Debug, Default, PartialEq, Serialize, Deserialize)]
    #[serde(default, deny_unknown_fields)]
    struct Network {
        dim: usize,
        name: String,
    }

    impl Schema for Config {
        fn refusal(&self) -> Option<(String, String)> {
            (self.network.dim > 9).then(|| ("network.dim".into(), "must be at most 9".into()))
        }
    }

    fn in_folder(files: &[(&str, &str)], overrides: &[&str]) -> Result<Config, String> {
        let folder = tempfile::tempdir().expect("temporary folder");
        for (name, text) in files {
            fs::create_dir_all(folder.path().join(name).parent().expect("a folder")).expect("made");
            fs::write(folder.path().join(name), text).expect("written");
        }
        let overrides: Vec<String> = overrides.iter().map(|s| (*s).to_owned()).collect();
        Config::from_file(&folder.path().join(files[0].0), &overrides).map_err(|e| e.to_string())
    }

    #[test]
    fn the_nearest_file_wins_and_overrides_win_over_all() {
        let files = [
            ("runs/a.toml", "extends = \"../b.toml\"\n[network]\ndim = 3\n"),
            ("b.toml", "extends = \"c.toml\"\n[network]\nname = \"b\"\n"),
            ("c.toml", "[network]\ndim = 1\nname = \"c\"\n"),
        ];
        let network = |dim, name: &str| Ok(Config { network: Network { dim, name: name.into() } });
        assert_eq!(in_folder(&files, &[]), network(3, "b"));
        assert_eq!(in_folder(&files, &["network.dim=4"]), network(4, "b"));
    }

    #[test]
    fn circles_missing_files_and_wrong_types_are_refused() {
        let circle = in_folder(&[("a.toml", "extends = \"a.toml\"\n")], &[]).expect_err("a circle");
        assert!(circle.contains("more than 8 configs"), "{circle}");
        let missing = in_folder(&[("a.toml", "extends = \"b.toml\"\n")], &[]).expect_err("no file");
        assert!(missing.contains("b.toml: cannot read"), "{missing}");
        let number = in_folder(&[("a.toml", "extends = 3\n")], &[]).expect_err("no path");
        assert!(number.contains("`extends` is a integer"), "{number}");
        let text = Config::from_toml("extends = \"b.toml\"", "x", &[]).expect_err("no file").to_string();
        assert!(text.contains("only a file"), "{text}");
    }

    #[test]
    fn errors_name_the_file_the_line_and_the_key_of_the_layer_that_is_wrong() {
        let files = [("a.toml", "extends = \"b.toml\"\n"), ("b.toml", "[network]\ndim = 1\ndims = 2\n")];
        let message = in_folder(&files, &[]).expect_err("unknown key");
        assert!(message.contains("b.toml: ") && message.contains("line 3") && message.contains("dims"));
        let files = [("a.toml", "extends = \"b.toml\"\n[network]\ndims = 2\n"), ("b.toml", "")];
        let message = in_folder(&files, &[]).expect_err("unknown key");
        assert!(message.contains("a.toml: ") && message.contains("line 3"), "{message}");
        let files = [("a.toml", "extends = \"b.toml\"\n"), ("b.toml", "[network]\ndim = 10\n")];
        let message = in_folder(&files, &[]).expect_err("too large");
        assert!(message.contains("a.toml extending") && message.contains("`network.dim`: must"), "{message}");
    }

    #[test]
    fn a_message_quotes_the_beginning_of_a_long_line() {
        let text = format!("[network]\nname = [{}\n", "1, ".repeat(100_000));
        let message = Config::from_toml(&text, "x", &[]).expect_err("a list").to_string();
        assert!(message.contains("name = [1, 1") && message.len() < 2000, "{}", message.len());
    }
}
