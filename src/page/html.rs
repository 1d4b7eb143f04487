//! The page as one self-contained HTML file with fonts and figures.

use std::fmt::Write;

use figures::{BOLD, REGULAR, escape, to_html, to_svg};

use super::style::grouped;
use super::{FigureContent, FigureEntry, PageBlock, PageTable, TableCell};

const STYLE: &str = include_str!("page.css");

/// Writes a page. Title and lead come above the sections, each with its heading; those without content are left out.
pub fn write<H: AsRef<str>>(title: &str, lead: &str, sections: Vec<(H, Vec<PageBlock<'_>>)>) -> String {
    let mut html = format!(
        "<!DOCTYPE html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\"/>\n\
         <meta name=\"viewport\" content=\"width=device-width, initial-scale=1\"/>\n<title>{}</title>\n<style>\n{}{}{STYLE}</style>\n\
         </head>\n<body>\n<h1>{}</h1>\n<p class=\"lead\">{}</p>\n",
        escape(title),
        face(REGULAR, "normal"),
        face(BOLD, "bold"),
        escape(title),
        to_html(lead)
    );
    for (heading, blocks) in sections {
        if blocks.is_empty() {
            continue;
        }
        let _ = writeln!(html, "<section>\n<h2>{}</h2>", escape(heading.as_ref()));
        for block in blocks {
            match block {
                PageBlock::Paragraph(words) => {
                    let _ = writeln!(html, "<p>{}</p>", to_html(&words));
                }
                PageBlock::Figure(part, number) => write_figure(&mut html, part, number),
                PageBlock::Table(table, number) => write_table(&mut html, table, number),
            }
        }
        html.push_str("</section>\n");
    }
    html.push_str("</body>\n</html>\n");
    html
}

fn write_figure(html: &mut String, part: &FigureEntry, number: usize) {
    let FigureEntry { name, title, drawn } = part;
    let _ = match drawn {
        Ok(FigureContent { figure, caption, .. }) => writeln!(
            html,
            "<figure id=\"figure-{name}\">\n<div class=\"drawing\">{}</div><figcaption><strong>Figure {number}. {}.</strong> {} \
             <span class=\"files\">Files: figures/{name}.svg, .png, .csv.</span></figcaption>\n</figure>",
            to_svg(figure),
            escape(title),
            to_html(caption)
        ),
        Err(why) => writeln!(
            html,
            "<p class=\"missing\" id=\"figure-{name}\"><strong>{}:</strong> not shown. {}</p>",
            escape(title),
            escape(why)
        ),
    };
}

fn write_table(html: &mut String, table: &PageTable, number: usize) {
    let PageTable { name, caption, titles, rows, shown } = table;
    let more = match rows.len().saturating_sub(*shown) {
        0 => String::new(),
        more => format!(" The file has {} more rows.", grouped(more as u64)),
    };
    let _ = writeln!(
        html,
        "<div class=\"scroll\"><table id=\"table-{name}\">\n<caption><div><strong>Table {number}.</strong> {}{more} \
         <span class=\"files\">File: tables/{name}.csv.</span></div></caption>",
        to_html(caption)
    );
    let is_number = |k: usize| rows.iter().all(|row| row.get(k).is_some_and(|cell| cell.is_number));
    if titles.iter().skip(1).any(|title| *title != "value") {
        let head = titles.iter().enumerate().map(|(k, title)| {
            let class = if is_number(k) { " class=\"number\"" } else { "" };
            format!("<th scope=\"col\"{class}>{}</th>", to_html(title))
        });
        let _ = writeln!(html, "<thead><tr>{}</tr></thead>", head.collect::<String>());
    }
    html.push_str("<tbody>\n");
    for row in rows.iter().take(*shown) {
        if let [heading] = row.as_slice() {
            let (columns, heading) = (titles.len(), escape(&heading.shown));
            let _ = writeln!(
                html,
                "<tr><th scope=\"rowgroup\" class=\"heading\" colspan=\"{columns}\">{heading}</th></tr>"
            );
            continue;
        }
        let cells = row.iter().enumerate().map(|(k, cell)| write_cell(k, cell));
        let _ = writeln!(html, "<tr>{}</tr>", cells.collect::<String>());
    }
    html.push_str("</tbody>\n</table></div>\n");
}

fn write_cell(column: usize, cell: &TableCell) -> String {
    let shown = escape(&cell.shown);
    match (column, cell.is_number) {
        (0, _) => format!("<th scope=\"row\">{shown}</th>"),
        (_, true) => format!("<td class=\"number\">{shown}</td>"),
        _ => format!("<td class=\"word\">{}</td>", breakable(&shown)),
    }
}

/// With places for line breaks between the elements of formulas: before an upper-case letter that follows a digit or a letter.
fn breakable(text: &str) -> String {
    let mut broken = String::with_capacity(text.len());
    let mut last = ' ';
    for next in text.chars() {
        if next.is_ascii_uppercase() && (last.is_ascii_lowercase() || last.is_ascii_digit()) {
            broken.push_str("<wbr/>");
        }
        broken.push(next);
        last = next;
    }
    broken
}

/// Embeds a font, so that the page looks the same everywhere.
fn face(font: &[u8], weight: &str) -> String {
    format!(
        "@font-face {{ font-family: 'Report Sans'; font-weight: {weight}; \
         src: url(data:font/ttf;base64,{}) format('truetype'); }}\n",
        base64(font)
    )
}

/// Base64 (RFC 4648).
fn base64(bytes: &[u8]) -> String {
    const DIGITS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let mut text = String::with_capacity(bytes.len().div_ceil(3) * 4);
    for group in bytes.chunks(3) {
        let byte = |k: usize| u32::from(group.get(k).copied().unwrap_or(0));
        let bits = byte(0) << 16 | byte(1) << 8 | byte(2);
        for k in 0..4 {
            let digit = DIGITS[(bits >> (18 - 6 * k) & 63) as usize];
            text.push(if k <= group.len() { char::from(digit) } else { '=' });
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn formulas_break_between_elements() {
        assert_eq!(breakable("Hf2NbO10"), "Hf2<wbr/>Nb<wbr/>O10");
        assert_eq!(breakable("4 completed, CO &amp; ROC-AUC"), "4 completed, CO &amp; ROC-AUC");
    }

    #[test]
    fn bytes_are_written_in_base_64() {
        for (bytes, expected) in
            [("", ""), ("f", "Zg=="), ("fo", "Zm8="), ("foo", "Zm9v"), ("foobar", "Zm9vYmFy")]
        {
            assert_eq!(base64(bytes.as_bytes()), expected);
        }
    }
}
