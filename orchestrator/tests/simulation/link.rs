//! Links between processes: messages take time, and faults lose, delay or repeat them.

use super::event::Event;
use super::fault::{Direction, LinkTrouble, Time};
use super::world::World;

/// Faults of links that last, with their end.
#[derive(Default)]
pub struct Links(Vec<(u32, Direction, LinkTrouble, Time)>);

impl Links {
    pub fn add(&mut self, link: u32, direction: Direction, trouble: LinkTrouble, until: Time) {
        self.0.push((link, direction, trouble, until));
    }

    /// What is wrong with a link now, in one direction.
    fn troubles(&mut self, link: u32, direction: Direction, now: Time) -> Vec<LinkTrouble> {
        self.0.retain(|(.., until)| *until > now);
        let of =
            |(number, way, ..): &&(u32, Direction, LinkTrouble, Time)| (*number, *way) == (link, direction);
        self.0.iter().filter(of).map(|(_, _, trouble, _)| *trouble).collect()
    }

    /// Ends the faults of a link.
    pub fn mend(&mut self, link: u32) {
        self.0.retain(|(number, ..)| *number != link);
    }
}

impl World {
    /// Sends a message, if the link lets it pass.
    pub fn send(&mut self, direction: Direction, walker: u32, event: Event) {
        let mut delay = self.random.between(1, 20);
        let mut copies = 1;
        for trouble in self.links.troubles(walker, direction, self.now) {
            match trouble {
                LinkTrouble::Cut => copies = 0,
                LinkTrouble::Loss => copies *= u64::from(self.random.happens(40)),
                LinkTrouble::Delay => delay += self.random.below(8_000),
                LinkTrouble::Repetition => copies *= self.random.between(1, 3),
            }
        }
        for _ in 0..copies {
            self.after(delay, event.clone());
            delay += self.random.below(3_000);
        }
    }
}
