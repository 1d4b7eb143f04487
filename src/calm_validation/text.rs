//! The page: what it says, and in which order; and the other files.

use atoms::extxyz::{Column, ColumnData, Frame, write_frame};

use super::labelled::LabelledSet;
use super::set_names::of_set;
use super::tables::both;
use super::{Defect, MatchedPair, Validation, figures, tables};
use crate::exit_status::CommandError;
use crate::page::{self, PageBlock, PageFile, Section};

/// File name of the page.
pub const PAGE: &str = "validation.html";

/// All files, the page first.
pub fn files(validation: &Validation) -> Result<Vec<PageFile>, CommandError> {
    let (parts, tables) = (figures::all(validation), tables::all(validation));
    let title = format!("Validation of the extrapolation grade: {}", validation.elements.join(", "));
    let text = page::write(&title, &lead(validation), sections(&validation.labelled, &parts, &tables));
    let json = serde_json::to_vec_pretty(validation).map_err(CommandError::failed)?;
    let mut files = vec![
        PageFile { path: PAGE.to_owned(), bytes: text.into_bytes() },
        PageFile { path: "validation.json".into(), bytes: json },
        PageFile { path: "structures.extxyz".into(), bytes: structures(&validation.defects)? },
        PageFile { path: "collisions.extxyz".into(), bytes: pairs(&validation.matched_pairs)? },
    ];
    files.extend(page::files(parts, &tables)?);
    Ok(files)
}

fn sections<'a>(
    sets: &[LabelledSet],
    parts: &'a [page::FigureEntry],
    tables: &'a [page::PageTable],
) -> Vec<(String, Vec<PageBlock<'a>>)> {
    let figure = |name: &str| PageBlock::figure(parts, name);
    let table = |name: &str| PageBlock::table(tables, name);
    let blocks = |blocks: Vec<Option<PageBlock<'a>>>| blocks.into_iter().flatten().collect::<Vec<_>>();
    let words = |words: &str| Some(PageBlock::Paragraph(words.into()));
    let mut sections: Vec<Section<'a>> = vec![
        (
            "Compression and stretching",
            blocks(vec![
                words(
                    "A grade should call crystals near equilibrium interpolation, and both compressed and stretched ones extrapolation.",
                ),
                table("detection"),
                figure("bond-scans"),
                table("bond-scans"),
            ]),
        ),
        (
            "Defects",
            blocks(vec![
                words(
                    "A grade should be largest at the defect and fall to that of the perfect crystal within a few layers, unless defects were \
                     in the training data. The file structures.extxyz has the structures with gamma and gamma_nbr.",
                ),
                figure("vacancies"),
                figure("surfaces"),
                figure("grain-boundaries"),
                figure("structures"),
                table("defects"),
            ]),
        ),
        ("Composition", blocks(vec![figure("solutions"), table("solutions"), table("training-data")])),
        (
            "Feature space",
            blocks(vec![
                words(
                    "γ is the distance to the nearest component, relative to its threshold. Labelled atoms far from all components are outside the data.",
                ),
                figure("feature-space"),
                table("feature-space"),
            ]),
        ),
        (
            "Colliding environments",
            blocks(vec![
                words(
                    "Environments that differ should have features that differ: otherwise no score can tell them apart.",
                ),
                table("collisions"),
                table("collision-search").and(words(
                    "Pairs can also be searched. A pair of other environments with the same hidden layer, to 10⁻⁹ in the paper, also has the same \
                     energy of the atom, and shows that scores of that layer must be blind somewhere. The features that γ grades should keep \
                     such a pair apart. A search that ends far away proves nothing. The file collisions.extxyz has the pairs.",
                )),
                table("collision-search"),
                table("feature-ranks").and(words(
                    "One atom’s features have fewer numbers than its environment has directions, so that some directions change none of them. The \
                     features of all atoms together should leave no direction but translations and rotations: their rank should be 3N − 6.",
                )),
                table("feature-ranks"),
            ]),
        ),
    ];
    if sets.len() > 1 {
        let blocks = [table("labelled-sets"), figure("error-grid"), figure("error-grid-gamma")];
        sections.push(("Sets of labelled structures", blocks.into_iter().flatten().collect()));
    } else {
        let blocks = [figure("error-grid"), figure("error-grid-gamma")];
        sections.push(("Models on the labelled structures", blocks.into_iter().flatten().collect()));
    }
    let sections = sections.into_iter().map(|(heading, blocks)| (heading.to_owned(), blocks));
    let of_sets = sets.iter().enumerate().map(|(number, set)| {
        let heading = match sets.len() {
            1 => "Labelled structures".to_owned(),
            _ => format!("Labelled structures of {}", set.file),
        };
        (heading, labelled_set(parts, tables, (number, set)))
    });
    sections.chain(of_sets).collect()
}

/// What a set of labelled structures says.
fn labelled_set<'a>(
    parts: &'a [page::FigureEntry],
    tables: &'a [page::PageTable],
    (number, set): (usize, &LabelledSet),
) -> Vec<PageBlock<'a>> {
    let figure = |name: &str| PageBlock::figure(parts, &of_set(name, number));
    let table = |name: &str| PageBlock::table(tables, &of_set(name, number));
    let words = format!(
        "{}: a grade should rank the force errors of atoms, and few of the atoms within its limit should have large ones. Intervals are too \
         narrow for few structures, and for frames of one trajectory.",
        set.file
    );
    let blocks = [
        table("label-errors").and(Some(PageBlock::Paragraph(words))),
        table("label-errors"),
        figure("reliability"),
        figure("error-histograms"),
        figure("score-distributions"),
        table("ranks"),
        figure("contamination"),
        table("confident"),
        figure("auc-sweep"),
        table("auc-thresholds"),
        table("worst-deciles"),
        table("quantiles"),
        table("element-errors"),
        figure("composition-errors"),
        table("composition-errors"),
        figure("mixture-contamination"),
        figure("mixture-map"),
        table("mixtures"),
    ];
    blocks.into_iter().flatten().collect()
}

fn lead(validation: &Validation) -> String {
    let gamma = &validation.scores[0];
    let tested = validation.bond_scans.iter().filter(|scan| scan.is_ground_state).count();
    let labelled: String = validation.labelled.iter().map(ranking).collect();
    format!(
        "Tests without labels, of a model with a cutoff of {} Å. In the bond scans of {tested} of {}, γ detects \
         compression/stretching: {}.{labelled}",
        validation.cutoff,
        crate::output::count(validation.elements.len() as u64, "element"),
        both(&gamma.detection)
    )
}

/// How well the first score, γ, ranks the force errors of labelled structures.
fn ranking(LabelledSet { report, .. }: &LabelledSet) -> String {
    let structures = crate::output::count(report.structures, "labelled structure");
    let rho = report.scores.first().and_then(|score| score.spearman.value);
    rho.map_or(format!(" {structures} without an order of force errors."), |rho| {
        format!(" In {structures}, Spearman’s ρ of γ and force error is {rho:.3}.")
    })
}

/// The structures of the defects with their grades, extended XYZ.
fn structures(defects: &[Defect]) -> Result<Vec<u8>, CommandError> {
    let mut bytes = Vec::new();
    for defect in defects {
        let Some((structure, gamma, averages)) = &defect.graded else { continue };
        let mut frame = Frame::from(structure.clone());
        let name = format!("{} {} {}", defect.element, defect.prototype, defect.name);
        frame.info.insert("name".into(), name.into());
        for (name, values) in [("gamma", gamma), ("gamma_nbr", averages)] {
            let column = Column { width: 1, entries: ColumnData::Real(values.clone()) };
            frame.arrays.insert(name.to_owned(), column);
        }
        write_frame(&mut bytes, &frame).map_err(CommandError::failed)?;
    }
    Ok(bytes)
}

/// The environments of all pairs, A before B, extended XYZ.
fn pairs(pairs: &[MatchedPair]) -> Result<Vec<u8>, CommandError> {
    let mut bytes = Vec::new();
    for pair in pairs {
        let (features, start) = (pair.features.name(), pair.start.name());
        for (structure, which) in pair.structures.iter().zip(["A", "B"]) {
            let mut frame = Frame::from(structure.clone());
            let name = format!("{} {features}, {start}, M = {}: {which}", pair.element, pair.neighbours);
            frame.info.insert("name".into(), name.into());
            write_frame(&mut bytes, &frame).map_err(CommandError::failed)?;
        }
    }
    Ok(bytes)
}
