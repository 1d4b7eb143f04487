//! Energies, forces and stresses of the potential against those of labels.

use ::figures::{Axis, AxisScale, Colour, Figure, Panel, Rectangle};
use monitor::label_statistics::parity::ParityErrors;
use wire::Origin;

use super::super::report_data::ReportData;
use super::super::style::{WIDTH, axis, grouped, origin_style, origins};
use super::super::{Csv, FigureContent, csv};
use super::{NO_LABELS, row};
use crate::output::decimals;
use crate::wording::parity::{ENERGY, FORCE, ParityQuantity, STRESS};

pub fn draw(data: &ReportData) -> Result<FigureContent, String> {
    let parity = &data.labels.as_ref().ok_or(NO_LABELS)?.statistics.parity;
    if parity.force.number() == 0 {
        return Err(NO_LABELS.into());
    }
    let quantities = [(ENERGY, &parity.energy), (FORCE, &parity.force), (STRESS, &parity.stress)];
    let mut figure = Figure::new("parity", "Energies, forces and stresses against labels", WIDTH, 184.0);
    let mut numbers = Csv::new(&["panel", "origin", "candidate", "label", "potential"]);
    let places = row(3, [46.0, 50.0, 12.0], 28.0, 118.0);
    for ((k, (quantity, errors)), place) in quantities.iter().enumerate().zip(places) {
        draw_panel(&mut figure, &mut numbers, (b'a' + k as u8) as char, quantity, errors, place);
    }
    origins(&mut figure, &[Origin::Biased, Origin::Control]);
    Ok(FigureContent { figure, caption: caption(data, &quantities), numbers })
}

fn draw_panel(
    figure: &mut Figure,
    numbers: &mut Csv,
    letter: char,
    quantity: &ParityQuantity,
    errors: &ParityErrors,
    place: Rectangle,
) {
    let all: Vec<f64> = errors.points().flat_map(|point| [point.label, point.model]).collect();
    let all: Vec<f64> = all.iter().map(|value| value * quantity.value_factor).collect();
    let axis_of = |of: &str| {
        let found = axis("", AxisScale::Linear, &all, None);
        Axis::new(
            &format!("{} by the {of} ({})", quantity.short, quantity.figure_unit),
            AxisScale::Linear,
            found.low,
            found.high,
        )
    };
    let (x, y) = (axis_of("label"), axis_of("potential"));
    let (low, high) = (x.low, x.high);
    let mut panel = Panel::new(place, x, y);
    if errors.number() == 0 {
        panel.placeholder("none known");
    } else {
        panel.line([[low, low], [high, high]], Colour::GREY.dashed(0.7));
    }
    for origin in [Origin::Control, Origin::Biased] {
        let style = origin_style(origin);
        let of: Vec<_> = errors.points().filter(|point| point.origin == origin.name()).collect();
        let points: Vec<_> =
            of.iter().map(|point| [point.label, point.model].map(|x| x * quantity.value_factor)).collect();
        panel.dots(points, style.marker, 1.2, style.colour.faint(0.5), None);
        for point in of {
            let values = [point.label, point.model].map(|x| csv::number(x * quantity.value_factor));
            let names = [letter.to_string(), point.origin.to_owned(), point.id.clone()];
            numbers.push(&[&names[..], &values[..]].concat());
        }
    }
    panel.panel_letter(letter);
    panel.draw(figure);
}

fn caption(data: &ReportData, quantities: &[(ParityQuantity, &ParityErrors); 3]) -> String {
    let of = |(quantity, errors): &(ParityQuantity, &ParityErrors)| {
        if errors.number() == 0 {
            return format!("{}: none known", quantity.name);
        }
        let [mae, rmse] = [errors.mae(), errors.rmse()]
            .map(|error| decimals(error.map(|error| error * quantity.error_factor), quantity.digits));
        let (number, unit) = (grouped(errors.number()), quantity.error_unit);
        format!("{}: MAE {mae}, RMSE {rmse} {unit} over {number} {}", quantity.name, quantity.counted)
    };
    let all: Vec<_> = quantities.iter().map(of).collect();
    format!(
        "Values of the potential against those of the labels; dashed, equal values. {}. Energies are without the offsets of the elements, \
         in the zero of the potential. At most {} values of each are drawn, evenly spread over the decision log; the errors are of all.{}",
        all.join("; "),
        grouped(monitor::label_statistics::parity::MAX_POINTS as u64),
        data.collections.of_version()
    )
}
