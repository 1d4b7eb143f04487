//! The terminal in raw mode on the alternate screen; restored however the program ends.

use std::io::{self, Stdout, Write, stdout};
use std::panic;

use ratatui::crossterm::cursor::Show;
use ratatui::crossterm::execute;
use ratatui::crossterm::terminal::{
    EnterAlternateScreen, LeaveAlternateScreen, disable_raw_mode, enable_raw_mode,
};
use ratatui::prelude::CrosstermBackend;
use ratatui::{Frame, Terminal};

use crate::exit_status::CommandError;

/// The terminal while it is drawn on.
pub struct Screen {
    terminal: Terminal<CrosstermBackend<Stdout>>,
}

impl Screen {
    /// Switches the terminal to raw mode. A panic restores it before its message is printed.
    pub fn open() -> Result<Self, CommandError> {
        let report = panic::take_hook();
        panic::set_hook(Box::new(move |panic| {
            restore();
            report(panic);
        }));
        Self::enter().map_err(|error| {
            restore();
            CommandError::Failed(format!("cannot draw on this terminal: {error}"))
        })
    }

    fn enter() -> io::Result<Self> {
        enable_raw_mode()?;
        execute!(stdout(), EnterAlternateScreen)?;
        Ok(Self { terminal: Terminal::new(CrosstermBackend::new(stdout()))? })
    }

    /// Draws; only changes are sent to the terminal.
    pub fn draw(&mut self, draw: impl FnOnce(&mut Frame<'_>)) -> Result<(), CommandError> {
        let drawn = self.terminal.draw(draw);
        drawn
            .map(drop)
            .map_err(|error| CommandError::Failed(format!("cannot draw on this terminal: {error}")))
    }
}

impl Drop for Screen {
    fn drop(&mut self) {
        restore();
    }
}

/// Restores the terminal; ignores errors, as it may be closed.
fn restore() {
    let _ = disable_raw_mode();
    let _ = execute!(stdout(), LeaveAlternateScreen, Show);
    let _ = stdout().flush();
}
