//! Reading a condition, by recursive descent: `or` of `and`s of comparisons, `not` and parentheses.

use atoms::Species;

use super::{Comparison, Condition, Number, Text};
use crate::config::nearest;

/// Parentheses and `not` inside each other, at most: each takes some of the stack.
const DEEPEST: usize = 100;

const KINDS: [&str; 3] = ["biased", "control", "imported"];

/// What else a quantity may be called.
const SYNONYMS: [(&str, &str); 12] = [
    ("gamma_max", "gamma"),
    ("grade", "gamma"),
    ("natoms", "atoms"),
    ("n_atoms", "atoms"),
    ("force", "max_force"),
    ("forces", "max_force"),
    ("fmax", "max_force"),
    ("species", "element"),
    ("origin", "kind"),
    ("v", "volume"),
    ("t", "temperature"),
    ("version", "mixture_version"),
];

/// A text that is no condition.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("at character {position}: found {found}, expected {expected}")]
pub struct ConditionError {
    /// Where, from 1.
    pub position: usize,
    /// What stands there.
    pub found: String,
    /// What should.
    pub expected: String,
}

/// A word, a number, a sign or a text in quotes.
#[derive(Clone, Debug, PartialEq)]
enum Token {
    Word(String),
    Quoted(String),
    Sign(&'static str),
    End,
}

struct Parser {
    /// With their places, the end last.
    tokens: Vec<(usize, Token)>,
    next: usize,
    depth: usize,
}

/// Longer ones first.
const SIGNS: [&str; 8] = ["!=", "<=", ">=", "=", "<", ">", "(", ")"];

pub(super) fn parse(text: &str) -> Result<Condition, ConditionError> {
    let mut parser = Parser { tokens: tokens(text)?, next: 0, depth: 0 };
    let condition = parser.any()?;
    match parser.peek() {
        Token::End => Ok(condition),
        _ => Err(parser.wrong("'and', 'or' or the end")),
    }
}

fn tokens(text: &str) -> Result<Vec<(usize, Token)>, ConditionError> {
    let characters: Vec<char> = text.chars().collect();
    let (mut tokens, mut at) = (Vec::new(), 0);
    while let Some(&character) = characters.get(at) {
        let rest = &characters[at..];
        let begins = |sign: &&&str| sign.chars().zip(rest).filter(|(a, b)| a == *b).count() == sign.len();
        if character.is_whitespace() {
            at += 1;
        } else if let Some(sign) = SIGNS.iter().find(begins) {
            tokens.push((at, Token::Sign(sign)));
            at += sign.len();
        } else if matches!(character, '\'' | '"') {
            let Some(length) = rest[1..].iter().position(|c| *c == character) else {
                let found = "a text without an end".to_owned();
                return Err(ConditionError {
                    position: at + 1,
                    found,
                    expected: format!("another {character} behind it"),
                });
            };
            tokens.push((at, Token::Quoted(rest[1..=length].iter().collect())));
            at += length + 2;
        } else {
            let of_word = |c: &&char| c.is_alphanumeric() || matches!(c, '_' | '.' | '-' | '+');
            let word: String = rest.iter().take_while(of_word).collect();
            if word.is_empty() {
                let found = format!("'{character}'");
                let word = match character {
                    '&' => "; conditions are joined by the word 'and'",
                    '|' => "; conditions are joined by the word 'or'",
                    '!' | '~' => "; the opposite is said by the word 'not'",
                    _ => "",
                };
                let expected = format!("a name, a number, a comparison or a parenthesis{word}");
                return Err(ConditionError { position: at + 1, found, expected });
            }
            let length = word.chars().count();
            tokens.push((at, Token::Word(word)));
            at += length;
        }
    }
    tokens.push((characters.len(), Token::End));
    Ok(tokens)
}

impl Parser {
    fn peek(&self) -> &Token {
        // The end is never passed.
        &self.tokens[self.next.min(self.tokens.len() - 1)].1
    }

    fn take(&mut self) -> Token {
        let token = self.peek().clone();
        self.next = (self.next + 1).min(self.tokens.len() - 1);
        token
    }

    fn wrong(&self, expected: impl Into<String>) -> ConditionError {
        let (position, token) = &self.tokens[self.next];
        let found = match token {
            Token::Word(word) | Token::Quoted(word) => format!("'{word}'"),
            Token::Sign(sign) => format!("'{sign}'"),
            Token::End => "the end".to_owned(),
        };
        ConditionError { position: position + 1, found, expected: expected.into() }
    }

    /// Takes the keyword, if it is next.
    fn keyword(&mut self, keyword: &str) -> bool {
        let is_next = matches!(self.peek(), Token::Word(word) if word.eq_ignore_ascii_case(keyword));
        if is_next {
            self.take();
        }
        is_next
    }

    fn any(&mut self) -> Result<Condition, ConditionError> {
        let mut left = self.all()?;
        while self.keyword("or") {
            left = Condition::Or(Box::new(left), Box::new(self.all()?));
        }
        Ok(left)
    }

    fn all(&mut self) -> Result<Condition, ConditionError> {
        let mut left = self.one()?;
        while self.keyword("and") {
            left = Condition::And(Box::new(left), Box::new(self.one()?));
        }
        Ok(left)
    }

    fn one(&mut self) -> Result<Condition, ConditionError> {
        if self.depth == DEEPEST {
            return Err(self.wrong(format!("at most {DEEPEST} parentheses and 'not' inside each other")));
        }
        self.depth += 1;
        let condition = if self.keyword("not") {
            Condition::Not(Box::new(self.one()?))
        } else if *self.peek() == Token::Sign("(") {
            self.take();
            let inside = self.any()?;
            if *self.peek() != Token::Sign(")") {
                return Err(self.wrong("'and', 'or' or ')'"));
            }
            self.take();
            inside
        } else {
            self.comparison()?
        };
        self.depth -= 1;
        Ok(condition)
    }

    fn comparison(&mut self) -> Result<Condition, ConditionError> {
        let name = match self.peek() {
            Token::Word(name) => name.clone(),
            _ => return Err(self.wrong(names())),
        };
        if let Some((column, _)) = Number::ALL.iter().find(|(_, known)| *known == name) {
            self.take();
            let comparison = self.comparison_sign()?;
            return Ok(Condition::Number(*column, comparison, self.number()?));
        }
        let Some((column, _)) = Text::ALL.iter().find(|(_, known)| *known == name) else {
            return Err(self.wrong(format!("{}{}", names(), hint(&name, all_names()))));
        };
        self.take();
        let wanted = match self.peek() {
            Token::Sign("=") => true,
            Token::Sign("!=") => false,
            _ => return Err(self.wrong(format!("= or != behind {name}"))),
        };
        self.take();
        Ok(Condition::Text(*column, wanted, self.text(*column)?))
    }

    fn comparison_sign(&mut self) -> Result<Comparison, ConditionError> {
        let comparison = match self.peek() {
            Token::Sign("=") => Comparison::Equal,
            Token::Sign("!=") => Comparison::Different,
            Token::Sign("<") => Comparison::Below,
            Token::Sign("<=") => Comparison::AtMost,
            Token::Sign(">") => Comparison::Above,
            Token::Sign(">=") => Comparison::AtLeast,
            _ => return Err(self.wrong("one of = != < <= > >=")),
        };
        self.take();
        Ok(comparison)
    }

    fn number(&mut self) -> Result<f64, ConditionError> {
        let number = match self.peek() {
            Token::Word(word) => word.parse().ok().filter(|number: &f64| number.is_finite()),
            _ => None,
        };
        let number = number.ok_or_else(|| self.wrong("a number"))?;
        self.take();
        Ok(number)
    }

    fn text(&mut self, column: Text) -> Result<String, ConditionError> {
        let (Token::Word(text) | Token::Quoted(text)) = self.peek().clone() else {
            return Err(self.wrong("a word, or a text in quotes"));
        };
        match column {
            Text::Element if text.parse::<Species>().is_err() => {
                return Err(self.wrong("the symbol of an element, as Mo"));
            }
            Text::Kind if !KINDS.contains(&text.as_str()) => {
                let kinds = KINDS.join(", ").replace(", imported", " or imported");
                return Err(self.wrong(format!("{kinds}{}", hint(&text, KINDS.into_iter()))));
            }
            _ => {}
        }
        self.take();
        Ok(text)
    }
}

fn all_names() -> impl Iterator<Item = &'static str> + Clone {
    Number::ALL.iter().map(|(_, name)| *name).chain(Text::ALL.iter().map(|(_, name)| *name))
}

fn names() -> String {
    format!("'not', '(' or one of {}", all_names().collect::<Vec<_>>().join(", "))
}

/// The name that was meant, if one is near.
fn hint<'a>(found: &str, names: impl Iterator<Item = &'a str> + Clone) -> String {
    let synonym =
        SYNONYMS.iter().find(|(other, _)| *other == found.to_ascii_lowercase()).map(|(_, name)| *name);
    match synonym.or_else(|| nearest(found, names)) {
        Some(name) => format!("; did you mean '{name}'?"),
        None => String::new(),
    }
}
