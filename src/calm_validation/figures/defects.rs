//! γ and γ_nbr by the distance to a defect (the paper's Figs. 3b–d and S8).

use figures::{Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel, Rectangle, Stroke};

use super::super::defects::{DefectKind, Shell};
use super::super::{Defect, Validation};
use super::layout::{
    OTHER_CRYSTAL, PanelGrid, axis, crystal_names, legend_height, legend_rows, letter, line, other_line,
    panel_name,
};
use crate::csv::{self, Csv};
use crate::page::FigureContent;
use crate::page::style::WIDTH;

/// Opacity of γ_nbr.
const PALE: f64 = 0.4;

pub fn draw(validation: &Validation, name: &'static str, kind: DefectKind) -> Result<FigureContent, String> {
    let all: Vec<_> = validation.defects.iter().filter(|defect| defect.kind == kind).collect();
    let graded: Vec<_> = all.iter().copied().filter(|defect| !defect.shells.is_empty()).collect();
    if graded.is_empty() {
        return Err(match all.iter().find_map(|defect| defect.error.as_ref()) {
            Some(error) => format!("No structure could be graded: {error}."),
            None => "No element has a crystal with this defect.".into(),
        });
    }
    // One panel for each element; the facets of a surface share it, and two crystals do.
    let panels: Vec<_> = graded.chunk_by(|a, b| a.element == b.element).collect();
    let keys = keys(kind, &panels);
    let grid = PanelGrid { number: panels.len(), height: 140.0, top: 20.0 + legend_height(&keys) };
    let description = format!("Extrapolation grade by the distance to the defect: {name}");
    let mut figure = Figure::new(name, &description, WIDTH, grid.total_height());
    legend_rows(&mut figure, &keys);
    for (k, defects) in panels.iter().enumerate() {
        draw_panel(&mut figure, kind, defects, grid.panel_rectangle(k), letter(k));
    }
    Ok(FigureContent { figure, caption: caption(kind, &graded), numbers: numbers(validation, &all) })
}

/// The lines of γ and γ_nbr of a defect: dashed in a crystal that the element does not form.
fn strokes(defect: &Defect) -> [Stroke; 2] {
    let k = if defect.kind == DefectKind::Surface { colour_index(defect.name) } else { 0 };
    let dashes: &'static [f64] = if defect.is_ground_state { &[] } else { other_line().dashes };
    let gamma = Stroke { dashes, ..line(k) };
    [gamma, pale(gamma)]
}

fn pale(stroke: Stroke) -> Stroke {
    Stroke { paint: stroke.paint.colour.faint(PALE), ..stroke }
}

fn keys(kind: DefectKind, panels: &[&[&Defect]]) -> Vec<(LegendKey, String)> {
    let defects = || panels.iter().copied().flatten();
    let mut keys = Vec::new();
    let gamma = if kind == DefectKind::Surface { Colour::INK.line(1.0) } else { line(0) };
    if kind == DefectKind::Surface {
        let mut names: Vec<&str> = Vec::new();
        for defect in defects() {
            if !names.contains(&defect.name) {
                names.push(defect.name);
            }
        }
        let key = |name: &&str| (LegendKey::Line(line(colour_index(name))), (*name).to_owned());
        keys.extend(names.iter().map(key));
    }
    keys.push((LegendKey::Line(gamma), "γ".into()));
    keys.push((LegendKey::Line(pale(gamma)), "γ_{nbr}".into()));
    if defects().any(|defect| !defect.is_ground_state) {
        keys.push((LegendKey::Line(Colour::INK.dashed(1.0)), OTHER_CRYSTAL.into()));
    }
    keys
}

/// Index of the colour of a facet.
fn colour_index(name: &str) -> usize {
    ["(111)", "(100)", "(110)", "(0001)"].iter().position(|facet| *facet == name).unwrap_or(0)
}

fn draw_panel(figure: &mut Figure, kind: DefectKind, defects: &[&Defect], place: Rectangle, letter: char) {
    let shells = || defects.iter().flat_map(|defect| &defect.shells);
    let values = shells().flat_map(|shell| [shell.scores[0], shell.largest[0], shell.averages[0]]);
    let farthest = shells().map(|shell| shell.distance).fold(0.0, f64::max);
    let title = match kind {
        DefectKind::Vacancy => "distance to the vacancy (Å)",
        DefectKind::Surface => "depth below the surface (Å)",
        DefectKind::GrainBoundary => "distance to the boundary (Å)",
    };
    let x = Axis::new(title, AxisScale::Linear, -0.02 * farthest, 1.02 * farthest);
    let mut panel = Panel::new(place, x, axis("γ", values));
    let (low, high) = (panel.x.low, panel.x.high);
    panel.line([[low, 1.0], [high, 1.0]], Colour::GREY.dashed(0.7));
    if let Some(crystal) = defects.iter().find_map(|defect| defect.crystal.first()) {
        panel.line([[low, *crystal], [high, *crystal]], Colour::GREY.line(0.5));
    }
    for defect in defects {
        let [gamma, average] = strokes(defect);
        let points =
            |of: fn(&Shell) -> f64| defect.shells.iter().map(move |shell| [shell.distance, of(shell)]);
        panel.line(points(|shell| shell.averages[0]), average);
        panel.line(points(|shell| shell.scores[0]), gamma);
        panel.dots(points(|shell| shell.scores[0]), Marker::Disc, 1.6, gamma.paint, None);
    }
    panel.panel_letter(letter);
    panel.draw(figure);
    let first = defects[0];
    let other = defects.iter().find(|defect| first.is_ground_state && !defect.is_ground_state);
    let dashed = other.map(|defect| defect.prototype.as_str());
    panel_name(figure, place, &first.element, &crystal_names(&first.prototype, dashed));
}

fn caption(kind: DefectKind, defects: &[&Defect]) -> String {
    let what = match kind {
        DefectKind::Vacancy => {
            "Mean grade of the atoms at each distance from the centre of a vacancy, in cells of about 100 to 200 atoms."
        }
        DefectKind::Surface => {
            "Mean grade of the layers of slabs with 3 × 3 surface cells, 9 to 15 layers and 12 Å of vacuum, which are periodic in two \
             directions, by their depth below the nearer surface."
        }
        DefectKind::GrainBoundary => {
            "Mean grade of the atoms at each distance from the symmetric Σ5 (310)[001] tilt boundary, folded over both boundaries of \
             the cell."
        }
    };
    let relaxed: Vec<_> = defects.iter().filter_map(|defect| defect.relaxation.as_ref()).collect();
    let unconverged: Vec<_> = defects
        .iter()
        .filter(|defect| defect.relaxation.as_ref().is_some_and(|found| !found.is_converged))
        .map(|defect| format!("{} {}", defect.element, defect.name))
        .collect();
    let relaxation = match (relaxed.is_empty(), unconverged.is_empty()) {
        (true, _) => "Positions are ideal.".to_owned(),
        (_, true) => {
            "Positions are relaxed at fixed cell; distances are those of the ideal structure.".to_owned()
        }
        _ => format!(
            "Positions are relaxed at fixed cell, without reaching the limit of the forces: {}; distances are those of the ideal structure.",
            unconverged.join(", ")
        ),
    };
    let others = match defects.iter().any(|defect| !defect.is_ground_state) {
        true => {
            " Dashed, a crystal that the element does not form, at ideal positions: bcc, or fcc for bcc elements."
        }
        false => "",
    };
    format!(
        "{what} {relaxation} γ_{{nbr}} is pale.{others} Dashed grey, the limit 1; thin grey, the perfect crystal of the ground state."
    )
}

fn numbers(validation: &Validation, defects: &[&Defect]) -> Csv {
    let mut titles: Vec<_> =
        ["element", "prototype", "defect", "distance", "atoms"].map(str::to_owned).to_vec();
    for score in &validation.scores {
        let name = &score.name;
        titles.extend([name.clone(), format!("{name}_largest"), format!("{name}_nbr")]);
    }
    let titles: Vec<_> = titles.iter().map(String::as_str).collect();
    let mut numbers = Csv::new(&titles);
    for defect in defects {
        for shell in &defect.shells {
            let mut row = vec![defect.element.clone(), defect.prototype.clone(), defect.name.to_owned()];
            row.extend([csv::number(shell.distance), shell.atoms.to_string()]);
            for k in 0..validation.scores.len() {
                row.extend([shell.scores[k], shell.largest[k], shell.averages[k]].map(csv::number));
            }
            numbers.push(&row);
        }
    }
    numbers
}
