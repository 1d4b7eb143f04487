//! Parses filters by recursive descent: `or` of `and`s of comparisons, `not` and parentheses.

use atoms::Species;
use dft::RetryAdjustment;

use super::{ComparisonOperator, NumberField, StructureFilter, TextField};
use crate::nearest_name::nearest;

/// Maximum nesting of parentheses and `not`, which limits recursion.
const MAX_DEPTH: usize = 100;

const ORIGINS: [&str; 3] = ["biased", "control", "imported"];

/// Synonyms of property names, for hints.
const SYNONYMS: [(&str, &str); 13] = [
    ("gamma_max", "gamma"),
    ("grade", "gamma"),
    ("natoms", "atoms"),
    ("n_atoms", "atoms"),
    ("force", "max_force"),
    ("forces", "max_force"),
    ("fmax", "max_force"),
    ("species", "element"),
    ("kind", "origin"),
    ("seed", "seed_structure"),
    ("volume", "relative_volume"),
    ("v", "relative_volume"),
    ("t", "temperature"),
];

/// A text that is no filter expression.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("at character {position}: found {found}, expected {expected}")]
pub struct FilterError {
    /// Position of the character, from 1.
    pub position: usize,
    /// What is there.
    pub found: String,
    /// What should be there.
    pub expected: String,
}

/// A word or number, a quoted text, or an operator.
#[derive(Clone, Debug, PartialEq)]
enum Token {
    Word(String),
    Quoted(String),
    Symbol(&'static str),
    End,
}

struct Parser {
    /// With their positions. The last one is the end.
    tokens: Vec<(usize, Token)>,
    next: usize,
    depth: usize,
}

/// Longer ones first.
const SYMBOLS: [&str; 8] = ["!=", "<=", ">=", "=", "<", ">", "(", ")"];

pub(super) fn parse(text: &str) -> Result<StructureFilter, FilterError> {
    let mut parser = Parser { tokens: tokenize(text)?, next: 0, depth: 0 };
    let filter = parser.disjunction()?;
    match parser.peek() {
        Token::End => Ok(filter),
        _ => Err(parser.error("'and', 'or' or the end")),
    }
}

fn tokenize(text: &str) -> Result<Vec<(usize, Token)>, FilterError> {
    let characters: Vec<char> = text.chars().collect();
    let (mut tokens, mut at) = (Vec::new(), 0);
    while let Some(&character) = characters.get(at) {
        let rest = &characters[at..];
        let begins = |sign: &&&str| sign.chars().zip(rest).filter(|(a, b)| a == *b).count() == sign.len();
        if character.is_whitespace() {
            at += 1;
        } else if let Some(sign) = SYMBOLS.iter().find(begins) {
            tokens.push((at, Token::Symbol(sign)));
            at += sign.len();
        } else if matches!(character, '\'' | '"') {
            let Some(length) = rest[1..].iter().position(|c| *c == character) else {
                let found = "an unterminated text".to_owned();
                return Err(FilterError {
                    position: at + 1,
                    found,
                    expected: format!("a closing {character}"),
                });
            };
            tokens.push((at, Token::Quoted(rest[1..=length].iter().collect())));
            at += length + 2;
        } else {
            let is_word_character = |c: &&char| c.is_alphanumeric() || matches!(c, '_' | '.' | '-' | '+');
            let word: String = rest.iter().take_while(is_word_character).collect();
            if word.is_empty() {
                let found = format!("'{character}'");
                let word = match character {
                    '&' => "; conditions are joined by the word 'and'",
                    '|' => "; conditions are joined by the word 'or'",
                    '!' | '~' => "; negation is the word 'not'",
                    _ => "",
                };
                let expected = format!("a name, a number, a comparison or a parenthesis{word}");
                return Err(FilterError { position: at + 1, found, expected });
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
        // The parser never passes the end.
        &self.tokens[self.next.min(self.tokens.len() - 1)].1
    }

    fn take(&mut self) -> Token {
        let token = self.peek().clone();
        self.next = (self.next + 1).min(self.tokens.len() - 1);
        token
    }

    fn error(&self, expected: impl Into<String>) -> FilterError {
        let (position, token) = &self.tokens[self.next];
        let found = match token {
            Token::Word(word) | Token::Quoted(word) => format!("'{word}'"),
            Token::Symbol(sign) => format!("'{sign}'"),
            Token::End => "the end".to_owned(),
        };
        FilterError { position: position + 1, found, expected: expected.into() }
    }

    /// Consumes the keyword if it is next.
    fn keyword(&mut self, keyword: &str) -> bool {
        let is_next = matches!(self.peek(), Token::Word(word) if word.eq_ignore_ascii_case(keyword));
        if is_next {
            self.take();
        }
        is_next
    }

    fn disjunction(&mut self) -> Result<StructureFilter, FilterError> {
        let mut left = self.conjunction()?;
        while self.keyword("or") {
            left = StructureFilter::Or(Box::new(left), Box::new(self.conjunction()?));
        }
        Ok(left)
    }

    fn conjunction(&mut self) -> Result<StructureFilter, FilterError> {
        let mut left = self.operand()?;
        while self.keyword("and") {
            left = StructureFilter::And(Box::new(left), Box::new(self.operand()?));
        }
        Ok(left)
    }

    fn operand(&mut self) -> Result<StructureFilter, FilterError> {
        if self.depth == MAX_DEPTH {
            return Err(self.error(format!("at most {MAX_DEPTH} nested parentheses and 'not'")));
        }
        self.depth += 1;
        let filter = if self.keyword("not") {
            StructureFilter::Not(Box::new(self.operand()?))
        } else if *self.peek() == Token::Symbol("(") {
            self.take();
            let inside = self.disjunction()?;
            if *self.peek() != Token::Symbol(")") {
                return Err(self.error("'and', 'or' or ')'"));
            }
            self.take();
            inside
        } else {
            self.comparison()?
        };
        self.depth -= 1;
        Ok(filter)
    }

    fn comparison(&mut self) -> Result<StructureFilter, FilterError> {
        let name = match self.peek() {
            Token::Word(name) => name.clone(),
            _ => return Err(self.error(names())),
        };
        if let Some((field, _)) = NumberField::ALL.iter().find(|(_, known)| *known == name) {
            self.take();
            let comparison = self.comparison_operator()?;
            return Ok(StructureFilter::Number(*field, comparison, self.number()?));
        }
        let Some((field, _)) = TextField::ALL.iter().find(|(_, known)| *known == name) else {
            return Err(self.error(format!("{}{}", names(), hint(&name, all_names()))));
        };
        self.take();
        let wanted = match self.peek() {
            Token::Symbol("=") => true,
            Token::Symbol("!=") => false,
            _ => return Err(self.error(format!("= or != after {name}"))),
        };
        self.take();
        Ok(StructureFilter::Text(*field, wanted, self.text(*field)?))
    }

    fn comparison_operator(&mut self) -> Result<ComparisonOperator, FilterError> {
        let comparison = match self.peek() {
            Token::Symbol("=") => ComparisonOperator::Equal,
            Token::Symbol("!=") => ComparisonOperator::Different,
            Token::Symbol("<") => ComparisonOperator::Below,
            Token::Symbol("<=") => ComparisonOperator::AtMost,
            Token::Symbol(">") => ComparisonOperator::Above,
            Token::Symbol(">=") => ComparisonOperator::AtLeast,
            _ => return Err(self.error("one of = != < <= > >=")),
        };
        self.take();
        Ok(comparison)
    }

    fn number(&mut self) -> Result<f64, FilterError> {
        let number = match self.peek() {
            Token::Word(word) => word.parse().ok().filter(|number: &f64| number.is_finite()),
            _ => None,
        };
        let number = number.ok_or_else(|| self.error("a number"))?;
        self.take();
        Ok(number)
    }

    fn text(&mut self, field: TextField) -> Result<String, FilterError> {
        let (Token::Word(text) | Token::Quoted(text)) = self.peek().clone() else {
            return Err(self.error("a word, or a quoted text"));
        };
        match field {
            TextField::Element if text.parse::<Species>().is_err() => {
                return Err(self.error("the symbol of an element, such as Mo"));
            }
            TextField::Origin if !ORIGINS.contains(&text.as_str()) => {
                let origins = ORIGINS.join(", ").replace(", imported", " or imported");
                return Err(self.error(format!("{origins}{}", hint(&text, ORIGINS.into_iter()))));
            }
            TextField::RetryAdjustment if RetryAdjustment::ALL.iter().all(|known| known.name() != text) => {
                let names = RetryAdjustment::ALL.map(RetryAdjustment::name);
                let hint = hint(&text, names.into_iter());
                return Err(self.error(format!("one of {}{hint}", names.join(", "))));
            }
            _ => {}
        }
        self.take();
        Ok(text)
    }
}

fn all_names() -> impl Iterator<Item = &'static str> + Clone {
    NumberField::ALL.iter().map(|(_, name)| *name).chain(TextField::ALL.iter().map(|(_, name)| *name))
}

fn names() -> String {
    format!("'not', '(' or one of {}", all_names().collect::<Vec<_>>().join(", "))
}

/// Suggests the name that was likely meant.
fn hint<'a>(found: &str, names: impl Iterator<Item = &'a str> + Clone) -> String {
    let synonym =
        SYNONYMS.iter().find(|(other, _)| *other == found.to_ascii_lowercase()).map(|(_, name)| *name);
    match synonym.or_else(|| nearest(found, names)) {
        Some(name) => format!("; did you mean '{name}'?"),
        None => String::new(),
    }
}
