//! What a device does when its server, or a call, fails: calls are made again, servers are started again.

use std::time::Instant;

use tracing::warn;

use crate::error::CallError;
use crate::faults::Fault;
use crate::running::{REFERENCE, Running, Suspect, Work};
use crate::same_model::have_same_energies;
use crate::schedule::{DeviceBatch, Kind, Ticket};
use crate::server::Server;

/// A server that fails so many times without an answer in between is given up.
const MAX_FAILURES: u32 = 3;

impl Running<'_> {
    /// Asks for a result once more, alone; if that has been tried, asks the reference structure.
    pub fn suspect(&mut self, ticket: Ticket, outcome: Result<Vec<f64>, String>) {
        if !ticket.alone {
            return self.schedule.put_back(vec![Ticket { alone: true, ..ticket }]);
        }
        if self.suspects.is_empty() {
            let kind = Kind::Evaluate { follows: false, features: false };
            let shape = self.reference.0.shape();
            let reference =
                Ticket { id: REFERENCE, client: REFERENCE, kind, shape, since: Instant::now(), alone: true };
            self.schedule.put_back(vec![reference]);
        }
        self.suspects.push(Suspect { ticket, outcome });
    }

    /// Compares the reference structure with what it was at the start. If it is the same, suspicious results are those of the model.
    pub fn judge(&mut self, energies: &[f64]) {
        let expected = &self.reference.1;
        if !have_same_energies(energies, expected) {
            let names = self.setup.settings.names();
            let sum = |energies: &[f64]| energies.iter().sum::<f64>();
            let message = format!(
                "{names}: the energy of the test structure is {} eV; it was {} eV at the start",
                sum(energies),
                sum(expected)
            );
            return self.restart(Fault::Nonsense(message));
        }
        for Suspect { ticket, outcome } in std::mem::take(&mut self.suspects) {
            self.interrupted.remove(&ticket.id);
            let Some(call) = self.calls.remove(&ticket.id) else { continue };
            match outcome {
                Ok(numbers) => {
                    if let Work::Evaluate { geometry, .. } = call.work {
                        self.clients.insert(call.client, geometry);
                    }
                    call.recipient.answer(numbers.len(), |out| out.copy_from_slice(&numbers));
                }
                Err(message) => call.recipient.refuse(&CallError::Failed(message)),
            }
        }
    }

    pub fn handle_fault(&mut self, fault: Fault, batch: DeviceBatch) {
        let tickets = batch.tickets();
        let bonds: usize = tickets.iter().map(|one| one.shape.bonds).sum();
        let is_device = matches!(fault, Fault::Memory(_));
        match fault {
            Fault::Memory(message) | Fault::Arena(message) if tickets.len() > 1 && bonds > 0 => {
                warn!(
                    message,
                    structures = tickets.len(),
                    bonds,
                    "the device is short of memory: smaller batches"
                );
                self.limit_bonds(bonds / 2, is_device);
                self.setup.note(|statistics| statistics.last_failure = Some(message));
                self.schedule.put_back(tickets);
            }
            Fault::Reported(message) if tickets.iter().any(|one| one.id == REFERENCE) => {
                self.restart(Fault::Nonsense(message));
            }
            Fault::Reported(message) => {
                warn!(message, "a call of the python server failed");
                for ticket in tickets.into_iter().rev() {
                    self.suspect(ticket, Err(message.clone()));
                }
            }
            fault => {
                self.interrupted.extend(tickets.iter().map(|one| one.id));
                self.schedule.put_back(tickets);
                self.restart(fault);
            }
        }
    }

    /// Limits the bonds of batches of several structures. What the memory of the device takes is kept for the next start.
    pub fn limit_bonds(&mut self, bonds: usize, is_device: bool) {
        self.schedule.limit_bonds(bonds);
        let limit = self.schedule.max_bonds();
        self.setup.note(|statistics| statistics.max_bonds = Some(limit as u64));
        if let Some(file) = self.limit_file.as_ref().filter(|_| is_device)
            && let Err(error) = file.write(limit)
        {
            warn!(%error, path = %file.path().display(), "cannot keep the size of batches for the next start");
        }
    }

    /// Limits batches to the size that was found before, if there is one.
    pub fn use_kept_limit(&mut self) {
        let Some((file, bonds)) = self.limit_file.as_ref().and_then(|file| Some((file, file.read()?))) else {
            return;
        };
        (self.progress)(&format!(
            "batches of at most {bonds} bonds, which the memory of {} took before (kept in {})",
            self.setup.settings.device,
            file.path().display()
        ));
        self.schedule.limit_bonds(bonds);
        self.setup.note(|statistics| statistics.max_bonds = Some(bonds as u64));
    }

    /// Ends the server and starts another one. Calls without results are sent again.
    pub fn restart(&mut self, mut fault: Fault) {
        let suspects = std::mem::take(&mut self.suspects).into_iter().map(|suspect| suspect.ticket);
        let sent = std::mem::take(&mut self.sent).into_iter().flat_map(|sent| sent.batch.tickets());
        let again: Vec<Ticket> = suspects.chain(sent).filter(|one| one.id != REFERENCE).collect();
        self.interrupted.extend(again.iter().map(|one| one.id));
        self.schedule.put_back(again);
        self.schedule.forget_server(REFERENCE);
        loop {
            if let Some(server) = self.server.take() {
                fault = server.end(fault);
            }
            if fault == Fault::Stopped {
                return self.give_up("interrupted while the model's server was started again");
            }
            self.failures += 1;
            let message = fault.message().to_owned();
            warn!(message, failures = self.failures, "the python server failed");
            self.setup.note(|statistics| statistics.last_failure = Some(message.clone()));
            if self.failures >= MAX_FAILURES {
                let reason = format!(
                    "the model's server failed {MAX_FAILURES} times in a row; the last time: {message}"
                );
                self.setup.broken.cancel();
                return self.give_up(&reason);
            }
            (self.progress)(&format!("{message}; starting the server again"));
            self.generation += 1;
            self.setup.note(|statistics| statistics.restarts += 1);
            let mut early = Vec::new();
            let setup = self.setup;
            match Server::start(setup, self.generation, &mut early) {
                Ok(server) if server.description.identity == self.identity => self.server = Some(server),
                Ok(server) => {
                    let names = setup.settings.names();
                    fault = server
                        .end(Fault::Nonsense(format!("{names}: the model has changed since the start")));
                }
                Err(start) => fault = start,
            }
            for event in early {
                if !self.handle(event) {
                    fault = Fault::Stopped;
                }
            }
            if self.server.is_some() && fault != Fault::Stopped {
                return;
            }
        }
    }

    /// Refuses all calls, now and later.
    pub fn give_up(&mut self, reason: &str) {
        self.given_up = Some(reason.to_owned());
        for (_, call) in self.calls.drain() {
            call.recipient.refuse(&CallError::Unavailable(reason.to_owned()));
        }
    }
}
