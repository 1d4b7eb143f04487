//! γ of random solid solutions against composition (the paper's Figs. 4a and 4d).

use figures::{Axis, AxisScale, Colour, Figure, LegendKey, Marker, Panel};

use super::super::solutions::{Composition, FirstShell};
use super::super::training::TrainingPair;
use super::super::{Solution, Validation};
use super::layout::{PanelGrid, axis, legend_rows, letter, line};
use crate::csv::{self, Csv};
use crate::page::FigureContent;
use crate::page::style::WIDTH;

/// Groups of fewer atoms are not drawn.
const MIN_ATOMS: usize = 10;
/// Colour of what the training data have.
const TRAINING: Colour = Colour::GREY;
/// The highest bar, in heights of the panel, and half the width of a bar, %.
const HIGHEST: f64 = 0.25;
const WIDE: f64 = 3.0;

pub fn draw(validation: &Validation) -> Result<FigureContent, String> {
    let graded = |solution: &&Solution| solution.compositions.iter().any(|of| of.structures > 0);
    let solutions: Vec<_> = validation.solutions.iter().filter(graded).collect();
    if solutions.is_empty() {
        return Err(match validation.solutions.is_empty() {
            true => "The model has no two elements that form close-packed or bcc metals.".into(),
            false => "No structure could be graded.".into(),
        });
    }
    let grid = PanelGrid { number: 3 * solutions.len(), height: 120.0, top: 36.0 };
    let description = "Extrapolation grade of random solid solutions against composition";
    let mut figure = Figure::new("solutions", description, WIDTH, grid.total_height());
    let mut keys = vec![
        (LegendKey::Line(line(0)), "γ".to_owned()),
        (LegendKey::Line(Colour::VERMILLION.dashed(1.2)), "γ_{nbr}".into()),
        (LegendKey::Dot(Marker::Disc, Colour::BLUE.into()), "first element".into()),
        (LegendKey::Dot(Marker::Square, Colour::INK.into()), "second element".into()),
    ];
    if validation.training.is_some() {
        keys.push((LegendKey::Dot(Marker::Square, TRAINING.into()), "training data".into()));
    }
    legend_rows(&mut figure, &keys);
    for (k, solution) in solutions.iter().enumerate() {
        draw_solution(&mut figure, (solution, training(validation, solution)), &grid, 3 * k);
    }
    Ok(FigureContent { figure, caption: caption(validation), numbers: numbers(validation) })
}

/// The training data of the elements of a solution.
fn training<'a>(validation: &'a Validation, solution: &Solution) -> Option<&'a TrainingPair> {
    validation.training.as_ref()?.pairs.iter().find(|pair| pair.elements == solution.elements)
}

fn draw_solution(
    figure: &mut Figure,
    (solution, training): (&Solution, Option<&TrainingPair>),
    grid: &PanelGrid,
    first: usize,
) {
    let [a, b] = &solution.elements;
    let compositions = || solution.compositions.iter().filter(|of| of.structures > 0);
    let shares = |title: &str| Axis::new(title, AxisScale::Linear, 0.0, 100.0);
    let curve = |of: fn(&Composition) -> f64| -> Vec<_> {
        compositions().map(|composition| [100.0 * composition.fraction, of(composition)]).collect()
    };
    let share = format!("{b} in {a}–{b} (%)");
    let [gamma, average] = [curve(|of| of.scores[0]), curve(|of| of.averages[0])];
    let values = gamma.iter().chain(&average).map(|[_, y]| *y);
    let mut panel = Panel::new(grid.panel_rectangle(first), shares(&share), axis("mean γ", values));
    draw_range(&mut panel, training);
    panel.line([[0.0, 1.0], [100.0, 1.0]], Colour::GREY.dashed(0.7));
    panel.line(average, Colour::VERMILLION.dashed(1.2));
    panel.line(gamma.clone(), line(0));
    panel.dots(gamma, Marker::Disc, 1.8, Colour::VERMILLION, None);
    panel.panel_letter(letter(first));
    panel.draw(figure);

    let y = Axis::new("atoms above 1 (%)", AxisScale::Linear, 0.0, 103.0);
    let mut panel = Panel::new(grid.panel_rectangle(first + 1), shares(&share), y);
    draw_range(&mut panel, training);
    panel.line(curve(|of| 100.0 * of.averages_above_1), Colour::VERMILLION.dashed(1.2));
    let above = curve(|of| 100.0 * of.above_1);
    panel.line(above.clone(), line(0));
    panel.dots(above, Marker::Disc, 1.8, Colour::VERMILLION, None);
    panel.panel_letter(letter(first + 1));
    panel.draw(figure);

    let groups = |element: &str| -> Vec<_> {
        let is_shown = |of: &&FirstShell| of.element == element && of.atoms >= MIN_ATOMS;
        let point = |of: &FirstShell| [100.0 * of.fraction, of.gamma];
        solution.first_shells.iter().filter(is_shown).map(point).collect()
    };
    let [of_a, of_b] = [groups(a), groups(b)];
    let values = of_a.iter().chain(&of_b).map(|[_, y]| *y);
    let y = axis("mean γ", values);
    let mut panel =
        Panel::new(grid.panel_rectangle(first + 2), shares(&format!("{b} in the first shell (%)")), y);
    draw_shells(&mut panel, training);
    panel.line([[0.0, 1.0], [100.0, 1.0]], Colour::GREY.dashed(0.7));
    for (points, marker, colour) in [(of_a, Marker::Disc, Colour::BLUE), (of_b, Marker::Square, Colour::INK)]
    {
        panel.line(points.clone(), colour.line(0.9));
        panel.dots(points, marker, 1.8, colour, None);
    }
    panel.panel_letter(letter(first + 2));
    panel.draw(figure);
}

/// The compositions of the training structures of both elements.
fn draw_range(panel: &mut Panel, training: Option<&TrainingPair>) {
    if let Some([low, high]) = training.and_then(|pair| pair.range) {
        let (bottom, top) = (panel.y.low, panel.y.high);
        panel.bar([100.0 * low, bottom], [100.0 * high, top], TRAINING.faint(0.25));
    }
}

/// The first shells of the atoms of the second element in the training structures, along the lower edge.
fn draw_shells(panel: &mut Panel, training: Option<&TrainingPair>) {
    let Some(pair) = training else { return };
    let of_second = || pair.shells.iter().filter(|shell| shell.element == pair.elements[1]);
    let most = of_second().map(|shell| shell.atoms).max().unwrap_or(0).max(1) as f64;
    let (bottom, top) = (panel.y.low, panel.y.high);
    for shell in of_second() {
        let (middle, share) = (100.0 * shell.fraction, shell.atoms as f64 / most);
        let end = bottom * (top / bottom).powf(HIGHEST * share);
        panel.bar([(middle - WIDE).max(0.0), bottom], [(middle + WIDE).min(100.0), end], TRAINING.faint(0.5));
    }
}

fn caption(validation: &Validation) -> String {
    let unrelaxed =
        validation.solutions.iter().flat_map(|of| &of.compositions).filter(|of| !of.is_relaxed).count();
    let unrelaxed = match unrelaxed {
        0 => String::new(),
        n => format!(
            " The model has no minimum of the energy near the mean distance of both elements in {n} of them, which is taken."
        ),
    };
    let training = match validation.training {
        Some(_) => {
            " Grey: left and middle, compositions between the smallest and the largest share of the second element in a training structure of both \
             elements alone; right, atoms of the second element in these structures by first shell, relative to the most frequent one."
        }
        None => "",
    };
    format!(
        "Random solid solutions of 128 atoms (bcc if the first element is, otherwise fcc), with one relaxed volume for each composition and \
         displacements of 0.1 Å for each Cartesian component; {} structures for each composition. Left, mean grade of all atoms; middle, share of \
         the atoms above 1; right, mean γ of the atoms of either element against the composition of their first shell, where there are at least \
         {MIN_ATOMS} atoms.{unrelaxed}{training}",
        validation.settings.solution_structures
    )
}

fn numbers(validation: &Validation) -> Csv {
    let mut numbers = Csv::new(&[
        "elements",
        "what",
        "element",
        "fraction",
        "distance",
        "number",
        "gamma",
        "gamma_nbr",
        "above_1",
        "nbr_above_1",
    ]);
    for solution in &validation.solutions {
        let pair = solution.elements.join("-");
        for of in &solution.compositions {
            let means = [
                of.scores.first().copied(),
                of.averages.first().copied(),
                Some(of.above_1),
                Some(of.averages_above_1),
            ];
            let mut row = vec![pair.clone(), "composition".into(), String::new()];
            row.extend([csv::number(of.fraction), csv::number(of.distance), of.structures.to_string()]);
            row.extend(means.map(csv::number));
            numbers.push(&row);
        }
        for of in &solution.first_shells {
            let row = [
                pair.clone(),
                "first shell".into(),
                of.element.clone(),
                csv::number(of.fraction),
                String::new(),
                of.atoms.to_string(),
                csv::number(of.gamma),
            ];
            numbers.push(&[&row[..], &[String::new(), String::new(), String::new()]].concat());
        }
        for of in training(validation, solution).into_iter().flat_map(|pair| &pair.shells) {
            let row = [
                pair.clone(),
                "first shell, training data".into(),
                of.element.clone(),
                csv::number(of.fraction),
                String::new(),
                of.atoms.to_string(),
            ];
            numbers.push(&[&row[..], &[const { String::new() }; 4]].concat());
        }
    }
    numbers
}
