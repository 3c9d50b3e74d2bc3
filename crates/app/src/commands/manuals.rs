//! `snapsnap completions` and `snapsnap man`.

use std::path::Path;

use clap::Command;
use clap_complete::Shell;
use clap_mangen::Man;

use crate::failure::Failure;
use crate::output::{self, make_folder};
use crate::say;

/// Prints the completions of `command`.
pub fn completions(shell: Shell, mut command: Command) -> Result<(), Failure> {
    let mut text = Vec::new();
    clap_complete::generate(shell, &mut command, "snapsnap", &mut text);
    say::result(&text)
}

/// Writes the manual pages of `command` and of its subcommands to a folder.
pub fn pages(folder: &Path, mut command: Command) -> Result<(), Failure> {
    // Computes the display names of subcommands.
    command.build();
    make_folder(folder)?;
    let mut count = 0;
    let mut waiting = vec![command];
    while let Some(command) = waiting.pop() {
        let name = command.get_display_name().unwrap_or_else(|| command.get_name()).to_owned();
        let mut page = Vec::new();
        let rendered = Man::new(command.clone()).title(&name).render(&mut page);
        rendered.map_err(|e| Failure::Internal(e.to_string()))?;
        output::write(&folder.join(format!("{name}.1")), &page)?;
        count += 1;
        // `help` contains all other commands again.
        let visible = |command: &&Command| !command.is_hide_set() && command.get_name() != "help";
        waiting.extend(command.get_subcommands().filter(visible).cloned());
    }
    say::info(&format!("{}: {count} pages", folder.display()));
    Ok(())
}
