//! Contour lines of a density (marching squares).

use std::collections::BTreeMap;

use crate::Density2d;

/// The edge of a grid square that a line crosses: it starts at grid point (column, row) and runs right if true,
/// up if false.
type GridEdge = (usize, usize, bool);

/// The closed contour lines at `level`. Lines that reach the edge of the grid are closed outside it.
pub fn contours(density: &Density2d, level: f64) -> Vec<Vec<[f64; 2]>> {
    let mut next = segments(density, level);
    let mut lines = Vec::new();
    while let Some((first, mut side)) = next.pop_first() {
        let mut line = vec![crossing(density, level, first)];
        while side != first {
            line.push(crossing(density, level, side));
            let Some(following) = next.remove(&side) else { break };
            side = following;
        }
        if line.len() > 2 {
            lines.push(line);
        }
    }
    lines
}

/// Maps the edge on which a line segment starts to the edge on which it ends, with the higher side on the left.
/// At most one segment starts on each edge.
fn segments(density: &Density2d, level: f64) -> BTreeMap<GridEdge, GridEdge> {
    let mut next = BTreeMap::new();
    for row in 0..=density.size() {
        for column in 0..=density.size() {
            let corner = |right: usize, up: usize| value(density, column + right, row + up) >= level;
            let [bottom, right, top, left] = [
                (column, row, true),
                (column + 1, row, false),
                (column, row + 1, true),
                (column, row, false),
            ];
            // Corners anticlockwise from the lower left. Side k lies between corners k and k + 1.
            let corners = [corner(0, 0), corner(1, 0), corner(1, 1), corner(0, 1)];
            let sides = [bottom, right, top, left];
            let falls = |k: usize| corners[k] && !corners[(k + 1) % 4];
            let rises = |k: usize| !corners[k] && corners[(k + 1) % 4];
            // A segment runs from a side where the density falls to the preceding side where it rises. If
            // opposite corners are above the level (a saddle), two segments separate them.
            for from in (0..4).filter(|k| falls(*k)) {
                if let Some(to) = (1..4).map(|k| (from + 4 - k) % 4).find(|k| rises(*k)) {
                    next.insert(sides[from], sides[to]);
                }
            }
        }
    }
    next
}

/// The density on the grid with a border of −∞. Indices count from the border.
fn value(density: &Density2d, column: usize, row: usize) -> f64 {
    let is_inside = |k: usize| k >= 1 && k <= density.size();
    if is_inside(column) && is_inside(row) { density.value(column - 1, row - 1) } else { f64::NEG_INFINITY }
}

fn crossing(density: &Density2d, level: f64, (column, row, is_horizontal): GridEdge) -> [f64; 2] {
    let (right, up) = if is_horizontal { (1, 0) } else { (0, 1) };
    let (from, to) = (value(density, column, row), value(density, column + right, row + up));
    let part = (level - from) / (to - from);
    let part = if part.is_finite() { part.clamp(0.0, 1.0) } else { 0.5 };
    density.point(column as f64 - 1.0 + part * right as f64, row as f64 - 1.0 + part * up as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn cloud(centre: [f64; 2]) -> impl Iterator<Item = [f64; 2]> {
        (0..400).map(move |k| {
            // Uniform points on the unit disc, by the golden angle.
            let (radius, angle) = ((f64::from(k) / 400.0).sqrt(), 2.399_963_23 * f64::from(k));
            [centre[0] + radius * angle.cos(), centre[1] + radius * angle.sin()]
        })
    }

    fn area(line: &[[f64; 2]]) -> f64 {
        let next = line.iter().cycle().skip(1);
        0.5 * line.iter().zip(next).map(|(a, b)| a[0] * b[1] - a[1] * b[0]).sum::<f64>()
    }

    #[test]
    fn a_disc_has_a_round_contour_through_its_level() {
        let points: Vec<_> = cloud([2.0, -1.0]).collect();
        let density = Density2d::from_points(&points, 96).unwrap();
        let level = density.level(&points, 0.95).unwrap();
        let lines = contours(&density, level);
        assert_eq!(lines.len(), 1);
        for point in &lines[0] {
            assert!((density.at(*point) / level - 1.0).abs() < 0.02, "{point:?}");
        }
        // The area, up to orientation, is about that of the disc.
        assert!((area(&lines[0]).abs() / std::f64::consts::PI - 1.0).abs() < 0.15, "{}", area(&lines[0]));
    }

    #[test]
    fn two_clouds_have_two() {
        let points: Vec<_> = cloud([0.0, 0.0]).chain(cloud([9.0, 9.0])).collect();
        let density = Density2d::from_points(&points, 96).unwrap();
        let lines = contours(&density, density.level(&points, 0.95).unwrap());
        assert_eq!(lines.len(), 2);
        assert!(area(&lines[0]) * area(&lines[1]) > 0.0, "both turn the same way");
    }

    #[test]
    fn what_reaches_the_edge_is_closed() {
        let points: Vec<_> = cloud([0.0, 0.0]).collect();
        let density = Density2d::from_points(&points, 32).unwrap();
        let lines = contours(&density, 0.0);
        assert_eq!(lines.len(), 1);
        assert_eq!(lines[0].len(), 4 * 32);
    }
}
