//! What a device does when its server, or a call, fails: calls are made again, servers are started again.

use std::time::Instant;

use tracing::warn;

use crate::error::CallError;
use crate::events::DeviceEvent;
use crate::faults::ServerFault;
use crate::same_model::{ModelReference, have_same_energies};
use crate::schedule::{DeviceBatch, Ticket, TicketKind};
use crate::self_test::Asked;
use crate::server::{Server, Synchronous};
use crate::server_loop::{CallKind, REFERENCE, ServerLoop, SuspectResult};

/// A server that fails so many times without an answer in between is given up, and a call that it fails at so many times is refused.
const MAX_FAILURES: u32 = 3;

impl ServerLoop<'_> {
    /// Asks for a result once more, alone; if that has been tried, asks the reference structure.
    pub fn suspect(&mut self, ticket: Ticket, outcome: Result<Vec<f64>, String>) {
        if !ticket.alone {
            return self.schedule.put_back(vec![Ticket { alone: true, ..ticket }]);
        }
        if self.suspects.is_empty() {
            let kind = TicketKind::Evaluate { follows: false, features: false, forces: true };
            let shape = self.test_structure.shape();
            let reference =
                Ticket { id: REFERENCE, client: REFERENCE, kind, shape, since: Instant::now(), alone: true };
            self.schedule.put_back(vec![reference]);
        }
        self.suspects.push(SuspectResult { ticket, outcome });
    }

    /// Compares the reference structure with what it was at the start. If it is the same, suspicious results are those of the model.
    pub fn check_reference(&mut self, energies: &[f64]) {
        let expected = &self.reference.energies;
        if !have_same_energies(energies, expected) {
            let names = self.setup.settings.names();
            let sum = |energies: &[f64]| energies.iter().sum::<f64>();
            let message = format!(
                "{names}: the energy of the test structure is {} eV; it was {} eV at the start",
                sum(energies),
                sum(expected)
            );
            let suspects = std::mem::take(&mut self.suspects).into_iter().map(|suspect| suspect.ticket);
            return self.restart(ServerFault::Nonsense(message), suspects.collect());
        }
        for SuspectResult { ticket, outcome } in std::mem::take(&mut self.suspects) {
            self.crashes.remove(&ticket.id);
            let Some(call) = self.calls.remove(&ticket.id) else { continue };
            match outcome {
                Ok(numbers) => {
                    if let CallKind::Evaluate { geometry, .. } = call.work {
                        self.clients.insert(call.client, geometry);
                    }
                    call.recipient.answer(numbers.len(), |out| out.copy_from_slice(&numbers));
                }
                Err(message) => call.recipient.refuse(&CallError::Failed(message)),
            }
        }
    }

    pub fn handle_fault(&mut self, fault: ServerFault, batch: DeviceBatch) {
        let tickets = batch.tickets();
        let bonds: usize = tickets.iter().map(|one| one.shape.bonds).sum();
        let is_device = matches!(fault, ServerFault::Memory(_));
        match fault {
            ServerFault::Memory(message) | ServerFault::Arena(message) if tickets.len() > 1 && bonds > 0 => {
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
            ServerFault::Reported(message) if tickets.iter().any(|one| one.id == REFERENCE) => {
                self.restart(ServerFault::Nonsense(message), tickets);
            }
            ServerFault::Reported(message) => {
                warn!(message, "a call of the python server failed");
                for ticket in tickets.into_iter().rev() {
                    self.suspect(ticket, Err(message.clone()));
                }
            }
            fault @ ServerFault::Arena(_) => {
                self.schedule.put_back(tickets);
                self.restart(fault, Vec::new());
            }
            fault => self.restart(fault, tickets),
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

    /// Ends the server and starts another one. Calls without results are made again; those that it `failed_at`, each alone. A call that
    /// it fails at again and again is refused, if the next server has the right results for the test structure.
    pub fn restart(&mut self, fault: ServerFault, failed_at: Vec<Ticket>) {
        let refused = self.make_calls_again(failed_at);
        let fault = match self.server.take() {
            Some(server) => server.end(fault),
            None => fault,
        };
        let message = fault.message().to_owned();
        // The one failure more is that of the next server.
        let most = MAX_FAILURES + u32::from(refused.is_some());
        if self.start_another(fault, most)
            && let Some(ticket) = refused
        {
            self.refuse(ticket, &message);
        }
    }

    /// Has calls without results wait again. Returns the one that is not made again.
    fn make_calls_again(&mut self, mut failed_at: Vec<Ticket>) -> Option<Ticket> {
        let suspects: Vec<Ticket> =
            std::mem::take(&mut self.suspects).into_iter().map(|one| one.ticket).collect();
        let mut others: Vec<Ticket> =
            std::mem::take(&mut self.sent).into_iter().flat_map(|sent| sent.batch.tickets()).collect();
        if failed_at.iter().any(|one| one.id == REFERENCE) {
            // The server was asked for the reference because of these.
            failed_at = suspects;
        } else {
            others.splice(0..0, suspects);
        }
        for ticket in &mut failed_at {
            ticket.alone = true;
            *self.crashes.entry(ticket.id).or_default() += 1;
        }
        let is_refused = |one: &Ticket| self.crashes.get(&one.id).is_some_and(|count| *count >= MAX_FAILURES);
        let refused = failed_at.iter().position(is_refused).map(|place| failed_at.remove(place));
        failed_at.extend(others.into_iter().filter(|one| one.id != REFERENCE));
        self.schedule.put_back(failed_at);
        self.schedule.forget_server(REFERENCE);
        refused
    }

    /// Ends the server and starts others until one is as at the start. Returns whether there is one; it is given up after `most` failures.
    fn start_another(&mut self, mut fault: ServerFault, most: u32) -> bool {
        loop {
            if let Some(server) = self.server.take() {
                fault = server.end(fault);
            }
            if fault == ServerFault::Stopped {
                self.give_up("interrupted while the model's server was started again");
                return false;
            }
            self.failures += 1;
            let message = fault.message().to_owned();
            warn!(message, failures = self.failures, "the python server failed");
            self.setup.note(|statistics| statistics.last_failure = Some(message.clone()));
            if self.failures >= most {
                self.fail_for_good(&format!(
                    "the model's server failed {MAX_FAILURES} times in a row; the last time: {message}"
                ));
                return false;
            }
            (self.progress)(&format!("{message}; starting the server again"));
            self.generation += 1;
            self.setup.note(|statistics| statistics.restarts += 1);
            let mut early = Vec::new();
            match self.start_server(&mut early) {
                Ok(server) => self.server = Some(server),
                Err(start) => fault = start,
            }
            for event in early {
                if !self.handle(event) {
                    fault = ServerFault::Stopped;
                }
            }
            if self.server.is_some() && fault != ServerFault::Stopped {
                return true;
            }
        }
    }

    /// Starts a server, whose model must be that of the first one.
    fn start_server(&self, early: &mut Vec<DeviceEvent>) -> Result<Server, ServerFault> {
        let mut server = Server::start(self.setup, self.generation, early)?;
        match self.check_model(&mut server, early) {
            Ok(()) => Ok(server),
            Err(fault) => Err(server.end(fault)),
        }
    }

    fn check_model(&self, server: &mut Server, early: &mut Vec<DeviceEvent>) -> Result<(), ServerFault> {
        let Self { setup, reference, .. } = self;
        let names = setup.settings.names();
        let changed = |why: String| ServerFault::Nonsense(format!("{names}: not as at the start: {why}"));
        let description = server.description.clone();
        reference.description.check_same(&description).map_err(changed)?;
        if setup.same_bits && reference.description.versions != description.versions {
            let [found, expected] =
                [&description, &reference.description].map(|one| one.device_and_versions());
            return Err(changed(format!(
                "{found}, expected {expected}: a reproducible campaign needs the same versions"
            )));
        }
        let mut calls = Synchronous { server, setup, early, fault: None };
        let found = calls.round_trip(0, &[&self.test_structure], Asked::Forces)?;
        let energies = found.into_iter().next().map(|one| one.energies).unwrap_or_default();
        reference.check(&ModelReference { description, energies }, setup.same_bits).map_err(changed)
    }

    /// The server fails at this call, but not at the test structure.
    fn refuse(&mut self, ticket: Ticket, message: &str) {
        let names = self.setup.settings.names();
        let reason = format!(
            "{names}: the server failed {MAX_FAILURES} times at this structure, but not at the test structure; the last time: {message}"
        );
        warn!(reason, client = ticket.client, "a call is refused");
        self.crashes.remove(&ticket.id);
        if let Some(call) = self.calls.remove(&ticket.id) {
            call.recipient.refuse(&CallError::Failed(reason.clone()));
        }
        (self.failures, self.refusals) = (0, self.refusals + 1);
        if self.refusals >= MAX_FAILURES {
            self.fail_for_good(&format!(
                "the model's server failed at {MAX_FAILURES} structures in a row; {reason}"
            ));
        }
    }

    /// Gives up, and lets everyone know.
    fn fail_for_good(&mut self, reason: &str) {
        self.setup.broken.cancel();
        self.give_up(reason);
    }

    /// Refuses all calls, now and later.
    pub fn give_up(&mut self, reason: &str) {
        self.given_up = Some(reason.to_owned());
        for (_, call) in self.calls.drain() {
            call.recipient.refuse(&CallError::Unavailable(reason.to_owned()));
        }
    }
}
