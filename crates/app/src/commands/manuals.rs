//! `snapsnap completions` and `snapsnap man`.

use std::path::PathBuf;

use clap::{Args, Command};
use clap_complete::Shell;
use clap_mangen::Man;

use crate::failure::Failure;
use crate::output::{self, make_folder};
use crate::say;

#[derive(Args)]
pub struct CompletionArguments {
    /// The shell.
    #[arg(value_enum)]
    shell: Shell,
}

#[derive(Args)]
pub struct ManArguments {
    /// Folder for the pages.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
}

/// Prints the completions of `command`.
pub fn completions(arguments: &CompletionArguments, mut command: Command) -> Result<(), Failure> {
    let mut text = Vec::new();
    clap_complete::generate(arguments.shell, &mut command, "snapsnap", &mut text);
    say::result(&text)
}

/// Writes the manual pages of `command` and of its subcommands.
pub fn pages(arguments: &ManArguments, mut command: Command) -> Result<(), Failure> {
    // Computes the display names of subcommands.
    command.build();
    make_folder(&arguments.output)?;
    let mut count = 0;
    let mut waiting = vec![command];
    while let Some(command) = waiting.pop() {
        let name = command.get_display_name().unwrap_or_else(|| command.get_name()).to_owned();
        let mut page = Vec::new();
        let rendered = Man::new(command.clone()).title(&name).render(&mut page);
        rendered.map_err(|e| Failure::Internal(e.to_string()))?;
        output::write(&arguments.output.join(format!("{name}.1")), &page)?;
        count += 1;
        // `help` contains all other commands again.
        let visible = |command: &&Command| !command.is_hide_set() && command.get_name() != "help";
        waiting.extend(command.get_subcommands().filter(visible).cloned());
    }
    say::info(&format!("{}: {count} pages", arguments.output.display()));
    Ok(())
}
