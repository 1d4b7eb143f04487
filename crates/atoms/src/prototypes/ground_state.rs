//! The crystal structures of the elements.

use super::Prototype;
use crate::Species;

/// The crystal of an element at low temperature, or a simple crystal in its place.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroundState {
    /// Its structure.
    pub prototype: Prototype,
    /// Distance of nearest neighbours, Å.
    pub distance: f64,
    /// Whether `prototype` is the element's own structure. Otherwise the element forms molecules or a crystal of lower
    /// symmetry, and the related or close-packed structure with its volume per atom, or a bond length, stands in.
    pub is_own: bool,
}

use Prototype::{Bcc, Diamond, Fcc, SimpleCubic};

const fn hcp(c_over_a: f64) -> Prototype {
    Prototype::Hcp { c_over_a }
}

/// Elements whose structure is a [`Prototype`], with the distance of nearest neighbours, Å: C. Kittel, Introduction to Solid State
/// Physics, 8th ed. (Wiley, 2005), chapter 1, tables 3 and 4, and N. W. Ashcroft and N. D. Mermin, Solid State Physics (Saunders,
/// 1976), chapters 4 and 7. Light actinides aside, they differ by less than 2 %. The double hexagonal La, Pr, Nd, Pm and Am, and
/// rhombohedral Sm, are other stackings of the same close-packed layers, and count as hcp. C is diamond; Sn is grey tin, stable
/// below 286 K.
const OWN: [(&str, Prototype, f64); 68] = [
    ("He", hcp(1.633), 3.57),
    ("Li", Bcc, 3.023),
    ("Be", hcp(1.581), 2.22),
    ("C", Diamond, 1.54),
    ("Ne", Fcc, 3.13),
    ("Na", Bcc, 3.659),
    ("Mg", hcp(1.623), 3.20),
    ("Al", Fcc, 2.86),
    ("Si", Diamond, 2.35),
    ("Ar", Fcc, 3.76),
    ("K", Bcc, 4.525),
    ("Ca", Fcc, 3.95),
    ("Sc", hcp(1.592), 3.25),
    ("Ti", hcp(1.587), 2.89),
    ("V", Bcc, 2.62),
    ("Cr", Bcc, 2.50),
    ("Fe", Bcc, 2.48),
    ("Co", hcp(1.622), 2.50),
    ("Ni", Fcc, 2.49),
    ("Cu", Fcc, 2.56),
    ("Zn", hcp(1.856), 2.66),
    ("Ge", Diamond, 2.45),
    ("Kr", Fcc, 4.00),
    ("Rb", Bcc, 4.837),
    ("Sr", Fcc, 4.30),
    ("Y", hcp(1.570), 3.55),
    ("Zr", hcp(1.593), 3.17),
    ("Nb", Bcc, 2.86),
    ("Mo", Bcc, 2.72),
    ("Tc", hcp(1.604), 2.71),
    ("Ru", hcp(1.582), 2.65),
    ("Rh", Fcc, 2.69),
    ("Pd", Fcc, 2.75),
    ("Ag", Fcc, 2.89),
    ("Cd", hcp(1.886), 2.98),
    ("Sn", Diamond, 2.81),
    ("Xe", Fcc, 4.34),
    ("Cs", Bcc, 5.235),
    ("Ba", Bcc, 4.35),
    ("La", hcp(1.61), 3.73),
    ("Ce", Fcc, 3.65),
    ("Pr", hcp(1.61), 3.63),
    ("Nd", hcp(1.61), 3.66),
    ("Sm", hcp(1.61), 3.59),
    ("Eu", Bcc, 3.96),
    ("Gd", hcp(1.592), 3.58),
    ("Tb", hcp(1.583), 3.52),
    ("Dy", hcp(1.574), 3.51),
    ("Ho", hcp(1.570), 3.49),
    ("Er", hcp(1.570), 3.47),
    ("Tm", hcp(1.570), 3.45),
    ("Yb", Fcc, 3.88),
    ("Lu", hcp(1.586), 3.43),
    ("Hf", hcp(1.583), 3.13),
    ("Ta", Bcc, 2.86),
    ("W", Bcc, 2.74),
    ("Re", hcp(1.616), 2.74),
    ("Os", hcp(1.577), 2.68),
    ("Ir", Fcc, 2.71),
    ("Pt", Fcc, 2.77),
    ("Au", Fcc, 2.88),
    ("Tl", hcp(1.599), 3.41),
    ("Pb", Fcc, 3.50),
    ("Po", SimpleCubic, 3.35),
    ("Ac", Fcc, 3.76),
    ("Th", Fcc, 3.60),
    ("Am", hcp(1.62), 3.45),
    ("Pm", hcp(1.61), 3.63),
];

/// Elements with a [`Prototype`] in the place of their structure: of which it is a distortion (Mn, In, Hg, Pa, and P, As, Sb, Bi, Se
/// and Te), which they have at high temperature (U, Np and Pu), or with the same volume per atom (Ga).
const DISTORTED: [(&str, Prototype, f64); 14] = [
    ("P", SimpleCubic, 2.4),
    ("Mn", Bcc, 2.4),
    ("Ga", Fcc, 3.0),
    ("As", SimpleCubic, 2.8),
    ("Se", SimpleCubic, 2.9),
    ("In", Fcc, 3.35),
    ("Sb", SimpleCubic, 3.1),
    ("Te", SimpleCubic, 3.1),
    ("Hg", Fcc, 3.15),
    ("Bi", SimpleCubic, 3.3),
    ("Pa", Bcc, 3.1),
    ("U", Bcc, 3.0),
    ("Np", Bcc, 3.0),
    ("Pu", Fcc, 3.28),
];

impl Species {
    /// The crystal of the element. Elements without a table entry, most of which form molecules, get fcc with 1.1 times
    /// the length of a single bond (twice the [covalent radius](Species::covalent_radius)).
    pub fn ground_state(self) -> GroundState {
        let find = |table: &[(&str, Prototype, f64)], is_own| {
            let of = |(_, prototype, distance)| GroundState { prototype, distance, is_own };
            table.iter().find(|(symbol, ..)| *symbol == self.symbol()).copied().map(of)
        };
        let distance = 2.2 * self.covalent_radius();
        find(&OWN, true).or_else(|| find(&DISTORTED, false)).unwrap_or(GroundState {
            prototype: Fcc,
            distance,
            is_own: false,
        })
    }
}
