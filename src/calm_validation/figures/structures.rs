//! Atoms at defects, coloured by γ (the insets of the paper's Fig. 3).

use atoms::cell::sub;
use atoms::{Repetition, Structure};
use figures::{Anchor, Colour, Figure, FigureItem, Marker, Paint, Rectangle};

use super::super::defects::DefectKind;
use super::super::{Defect, Validation};
use super::layout::letter;
use crate::csv::{self, Csv};
use crate::page::FigureContent;
use crate::page::style::{WIDTH, row};

/// Height of a drawing and of the scale, points.
const HEIGHT: f64 = 118.0;
const SCALE: f64 = 9.0;
/// Room around drawings, points.
const TOP: f64 = 18.0;
const BETWEEN: f64 = 26.0;
/// γ at the ends of the scale of colours; γ = 1 is in its middle.
const ENDS: [f64; 2] = [0.2, 5.0];
/// Elements with drawings.
const MAX_ELEMENTS: usize = 6;

pub fn draw(validation: &Validation) -> Result<FigureContent, String> {
    let shown: Vec<_> = validation.defects.iter().filter(|defect| is_shown(defect)).collect();
    let rows: Vec<_> = shown.chunk_by(|a, b| a.element == b.element).take(MAX_ELEMENTS).collect();
    if rows.is_empty() {
        return Err("No structure could be graded.".into());
    }
    let height = TOP + rows.len() as f64 * (HEIGHT + BETWEEN) + 30.0;
    let description = "Atoms around defects, coloured by extrapolation grade";
    let mut figure = Figure::new("structures", description, WIDTH, height);
    let mut numbers = Csv::new(&["element", "defect", "x", "y", "gamma"]);
    for (k, defects) in rows.iter().enumerate() {
        let top = TOP + k as f64 * (HEIGHT + BETWEEN);
        for (column, (defect, place)) in
            defects.iter().zip(row(3, [14.0, 22.0, 8.0], top, HEIGHT)).enumerate()
        {
            let name = format!("{}, {} {}", defect.element, defect.prototype, defect.name);
            figure.text([place.x + 12.0, place.y - 6.0], &name, Anchor::Start);
            let text = figure.text(
                [place.x - 6.0, place.y - 6.0],
                &letter(3 * k + column).to_string(),
                Anchor::Start,
            );
            (text.bold, text.size) = (true, 10.0);
            draw_atoms(&mut figure, &mut numbers, defect, place);
        }
    }
    draw_scale(&mut figure, height - 26.0);
    let caption = "Atoms of relaxed or ideal structures, coloured by their γ on the scale below; white is the limit 1. Vacancy: the layers next to \
                   it, along [001]; surface: the slab from the side; boundary: along the tilt axis [001], with both boundaries of the cell.";
    Ok(FigureContent { figure, caption: caption.into(), numbers })
}

/// A vacancy, one surface and a boundary of each element's ground state.
fn is_shown(defect: &Defect) -> bool {
    let is_first = match defect.kind {
        DefectKind::Surface => ["(111)", "(0001)"].contains(&defect.name),
        _ => true,
    };
    is_first && defect.is_ground_state && defect.graded.is_some()
}

/// Positions on the page (Å, to the right and up) of the atoms that are drawn, from the farthest to the nearest. A vacancy is in
/// the middle.
fn projected(defect: &Defect, structure: &Structure) -> Vec<(usize, [f64; 2])> {
    let mut structure = structure.clone();
    if defect.kind == DefectKind::GrainBoundary {
        // Twice along the boundary, which is the second lattice vector.
        structure = structure.repeated(Repetition([1, 2, 1]));
    }
    let mut positions = structure.positions.clone();
    if let Some(centre) = defect.centre {
        for r in &mut positions {
            let fractional = structure.cell.fractional(sub(*r, centre));
            *r = structure.cell.cartesian(fractional.map(|x| x - x.round()));
        }
    }
    let [right, up, towards] = if defect.kind == DefectKind::Surface { [0, 2, 1] } else { [0, 1, 2] };
    let nearest = defect.shells.first().map_or(0.0, |shell| shell.distance);
    let is_drawn = |atom: &usize| defect.centre.is_none() || positions[*atom][towards].abs() < 0.9 * nearest;
    let mut atoms: Vec<_> = (0..positions.len()).filter(is_drawn).collect();
    atoms.sort_by(|a, b| positions[*a][towards].total_cmp(&positions[*b][towards]));
    atoms.into_iter().map(|atom| (atom, [positions[atom][right], positions[atom][up]])).collect()
}

fn draw_atoms(figure: &mut Figure, numbers: &mut Csv, defect: &Defect, place: Rectangle) {
    let Some((structure, gamma, _)) = &defect.graded else { return };
    let atoms = projected(defect, structure);
    let range = |k: usize| {
        atoms
            .iter()
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), (_, r)| (low.min(r[k]), high.max(r[k])))
    };
    let ([left, right], [low, high]) = ([range(0).0, range(0).1], [range(1).0, range(1).1]);
    const MARGIN: f64 = 1.4;
    let scale =
        f64::min(place.width / (right - left + 2.0 * MARGIN), place.height / (high - low + 2.0 * MARGIN));
    let middle = [place.x + 0.5 * place.width, place.y + 0.5 * place.height];
    for (atom, [x, y]) in atoms {
        let centre =
            [middle[0] + scale * (x - 0.5 * (left + right)), middle[1] - scale * (y - 0.5 * (low + high))];
        figure.items.push(FigureItem::Dots {
            centres: vec![centre],
            marker: Marker::Disc,
            radius: (1.15 * scale).min(6.0),
            fill: Paint::from(colour(gamma[atom % gamma.len()])),
            stroke: Some(Colour::INK.line(0.35)),
            clip: None,
        });
        let cells = [defect.element.clone(), defect.name.to_owned()];
        numbers.push(&[&cells[..], &[x, y, gamma[atom % gamma.len()]].map(csv::number)].concat());
    }
}

/// Blue below 1, white at 1, vermillion above, on a logarithmic scale.
fn colour(gamma: f64) -> Colour {
    let [low, high] = ENDS;
    let (end, share) = match gamma < 1.0 {
        true => (Colour::BLUE, gamma.max(low).ln() / low.ln()),
        false => (Colour::VERMILLION, gamma.min(high).ln() / high.ln()),
    };
    let mix = |end: u8| (255.0 + (f64::from(end) - 255.0) * share).round() as u8;
    Colour(mix(end.0), mix(end.1), mix(end.2))
}

fn draw_scale(figure: &mut Figure, y: f64) {
    const STEPS: usize = 60;
    let (width, [low, high]) = (180.0, ENDS);
    let left = 0.5 * (WIDTH - width);
    for k in 0..STEPS {
        let gamma = low * (high / low).powf((k as f64 + 0.5) / STEPS as f64);
        let x = left + width * k as f64 / STEPS as f64;
        let step = Rectangle { x, y, width: width / STEPS as f64 + 0.2, height: SCALE };
        figure.rectangle(step, colour(gamma).into());
    }
    for (share, label) in [(0.0, "≤ 0.2"), (0.5, "1"), (1.0, "≥ 5")] {
        figure.text([left + share * width, y + SCALE + 10.0], label, Anchor::Middle);
    }
    figure.text([left - 24.0, y + SCALE - 1.0], "γ", Anchor::End);
}
