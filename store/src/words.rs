//! The words that views show for stored ends of walks, reasons to decline and failure classes. Stored words do not change:
//! they stand in rows with checksums.

/// Stored words with the words that views show. All others are shown as they are stored.
const WORDS: [(&str, &str); 7] = [
    ("steps", "completed"),
    ("collected", "quota_reached"),
    ("blew_up", "diverged"),
    ("bad_start", "invalid_start"),
    ("guard", "too_close"),
    ("lost_node", "node_failure"),
    ("refused", "rejected_by_label_guard"),
];

/// The word that views show for a stored end of a walk, reason to decline or failure class. Leaves a shown word as it is.
pub fn shown(word: &str) -> &str {
    WORDS.iter().find(|(stored, _)| *stored == word).map_or(word, |(_, shown)| shown)
}

/// The stored word for a shown one.
pub fn stored(word: &str) -> &str {
    WORDS.iter().find(|(_, shown)| *shown == word).map_or(word, |(stored, _)| stored)
}

/// As text: `quota reached`.
pub fn as_text(word: &str) -> String {
    shown(word).replace('_', " ")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_word_comes_back() {
        for (word, expected) in WORDS {
            assert_eq!((shown(word), stored(expected), shown(expected)), (expected, word, expected));
        }
        assert_eq!(
            (shown("covered"), stored("covered"), as_text("blew_up")),
            ("covered", "covered", "diverged".into())
        );
    }
}
