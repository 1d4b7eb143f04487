//! The text exposition format of Prometheus, version 0.0.4.

use std::fmt::Write;

/// Its media type.
pub const CONTENT_TYPE: &str = "text/plain; version=0.0.4; charset=utf-8";

/// Metrics as text, grouped by name.
#[derive(Debug, Default)]
pub struct MetricsText(String);

impl MetricsText {
    /// Adds a counter. Its name ends with `_total`.
    pub fn counter(&mut self, name: &str, help: &str, samples: &[(&[(&str, &str)], f64)]) {
        self.metric(name, "counter", help, samples);
    }

    /// Adds a gauge.
    pub fn gauge(&mut self, name: &str, help: &str, samples: &[(&[(&str, &str)], f64)]) {
        self.metric(name, "gauge", help, samples);
    }

    fn metric(&mut self, name: &str, kind: &str, help: &str, samples: &[(&[(&str, &str)], f64)]) {
        if samples.is_empty() {
            return;
        }
        let Self(text) = self;
        // Writing to a string cannot fail.
        let _ = write!(
            text,
            "# HELP {name} {}\n# TYPE {name} {kind}\n",
            help.replace('\\', r"\\").replace('\n', r"\n")
        );
        for (labels, value) in samples {
            let labels: Vec<_> =
                labels.iter().map(|(key, value)| format!("{key}=\"{}\"", escaped(value))).collect();
            let labels = if labels.is_empty() { String::new() } else { format!("{{{}}}", labels.join(",")) };
            let _ = writeln!(text, "{name}{labels} {}", number(*value));
        }
    }

    /// The text.
    pub fn into_string(self) -> String {
        self.0
    }
}

fn escaped(value: &str) -> String {
    value.replace('\\', r"\\").replace('"', "\\\"").replace('\n', r"\n")
}

fn number(value: f64) -> String {
    match value {
        value if value.is_nan() => "NaN".to_owned(),
        f64::INFINITY => "+Inf".to_owned(),
        f64::NEG_INFINITY => "-Inf".to_owned(),
        value => value.to_string(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn labels_and_help_are_escaped_and_numbers_are_whole() {
        let mut text = MetricsText::default();
        text.counter("a_total", "One\nline.", &[(&[("k", "a\"b\\c\n")], 3.0), (&[], 0.25)]);
        text.gauge("b", "Two.", &[]);
        text.gauge("c", "Three.", &[(&[], f64::NAN), (&[], f64::INFINITY)]);
        let expected = "# HELP a_total One\\nline.\n# TYPE a_total counter\na_total{k=\"a\\\"b\\\\c\\n\"} 3\na_total 0.25\n\
                        # HELP c Three.\n# TYPE c gauge\nc NaN\nc +Inf\n";
        assert_eq!(text.into_string(), expected);
    }
}
