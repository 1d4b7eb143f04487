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
}
