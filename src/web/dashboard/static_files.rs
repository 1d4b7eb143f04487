//! The files of the pages, embedded in the program.

use axum::extract::Path;
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};

use super::response::{ApiError, ApiResult};

macro_rules! files {
    ($($name:literal),* $(,)?) => {
        &[$(($name, include_str!(concat!("../pages/", $name)))),*]
    };
}

const INDEX: &str = include_str!("../pages/index.html");

/// Every file that `index.html` and its modules name.
const FILES: &[(&str, &str)] = files![
    "actions.js",
    "api.js",
    "calibration.js",
    "campaign_state.js",
    "candidate.js",
    "candidates.js",
    "colours.js",
    "comparison.js",
    "dom.js",
    "elements.js",
    "errors.js",
    "format.js",
    "gallery.js",
    "geometry.js",
    "history.js",
    "hosts.js",
    "icon.svg",
    "legend.js",
    "main.js",
    "map.js",
    "mixture.js",
    "overview.js",
    "painting.js",
    "parity.js",
    "plot.js",
    "plots.js",
    "structure.js",
    "style.css",
    "versions.js",
    "walk.js",
];

/// `GET /`
pub async fn index() -> Response {
    answer("text/html; charset=utf-8", INDEX)
}

/// `GET /pages/NAME`
pub async fn file(Path(name): Path<String>) -> ApiResult {
    let found = FILES.iter().find(|(known, _)| *known == name);
    let (name, text) = found.ok_or_else(|| ApiError::new(StatusCode::NOT_FOUND, "no such file"))?;
    let kind = match name.rsplit('.').next() {
        Some("css") => "text/css; charset=utf-8",
        Some("svg") => "image/svg+xml",
        _ => "text/javascript; charset=utf-8",
    };
    Ok(answer(kind, text))
}

fn answer(kind: &'static str, text: &'static str) -> Response {
    // Tomorrow another version of the program may serve this address.
    ([(header::CONTENT_TYPE, kind), (header::CACHE_CONTROL, "no-cache")], text).into_response()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The quoted texts that follow a word.
    fn named<'a>(text: &'a str, before: &str) -> Vec<&'a str> {
        let parts = text.split(before).skip(1);
        parts.filter_map(|part| part.split('"').next()).collect()
    }

    #[test]
    fn every_file_that_is_named_is_there_and_no_other() {
        let mut wanted = named(INDEX, "=\"/pages/");
        for (_, text) in FILES {
            wanted.extend(named(text, "from \"./"));
        }
        wanted.sort_unstable();
        wanted.dedup();
        let here: Vec<_> = FILES.iter().map(|(name, _)| *name).collect();
        assert_eq!(wanted, here);
    }

    #[test]
    fn no_text_becomes_markup_and_nothing_comes_from_elsewhere() {
        for (name, text) in FILES {
            for forbidden in ["innerHTML", "outerHTML", "insertAdjacentHTML", "document.write", "eval("] {
                assert!(!text.contains(forbidden), "{name}: {forbidden}");
            }
            let elsewhere = text.replace("http://www.w3.org/2000/svg", "");
            assert!(!elsewhere.contains("http://") && !elsewhere.contains("https://"), "{name}");
        }
    }

    /// Relative luminance of a colour `#rrggbb` (WCAG 2.2).
    fn luminance(colour: &str) -> f64 {
        let channel = |place: usize| {
            let value = f64::from(u8::from_str_radix(&colour[place..place + 2], 16).unwrap()) / 255.0;
            if value <= 0.04045 { value / 12.92 } else { ((value + 0.055) / 1.055).powf(2.4) }
        };
        0.2126 * channel(1) + 0.7152 * channel(3) + 0.0722 * channel(5)
    }

    /// WCAG 2.2, 1.4.11: graphics have a contrast of at least 3.
    #[test]
    fn lines_and_marks_stand_out_on_light_and_dark_paper() {
        let text = FILES.iter().find(|(name, _)| *name == "colours.js").unwrap().1;
        let colours: Vec<_> =
            text.match_indices("\"#").map(|(place, _)| &text[place + 1..place + 8]).collect();
        assert!(colours.len() > 12, "{colours:?}");
        for paper in ["#ffffff", "#18212a"] {
            let of_paper = luminance(paper);
            for colour in &colours {
                let of_line = luminance(colour);
                let contrast = (of_line.max(of_paper) + 0.05) / (of_line.min(of_paper) + 0.05);
                assert!(contrast >= 3.0, "{colour} on {paper}: {contrast:.2}");
            }
        }
        let style = FILES.iter().find(|(name, _)| *name == "style.css").unwrap().1;
        assert!(style.contains("--paper: #fff;") && style.contains("--paper: #18212a;"));
    }
}
