//! Parses the header of an `.npy` file as specified by NumPy (NEP 1).
//!
//! `npyz` has a parser too, but it multiplies dimensions without overflow checks and accepts any Python
//! literal, and deeply nested ones overflow the stack. This parser accepts what NumPy writes: a dictionary of
//! exactly three entries.

use std::io::Read;

use npyz::TypeStr;

/// Longest header text, bytes. NumPy warns above 10 000.
const MAX_HEADER_BYTES: usize = 1 << 16;

/// Type and shape of an array.
#[derive(Debug)]
pub(crate) struct NpyHeader {
    pub kind: TypeStr,
    pub fortran_order: bool,
    pub shape: Vec<usize>,
    /// Offset of the data in the file, bytes.
    pub length: u64,
}

impl NpyHeader {
    /// Reads up to the start of the data.
    pub fn read(mut source: impl Read) -> Result<Self, String> {
        let mut fixed = [0; 8];
        source.read_exact(&mut fixed).map_err(|error| error.to_string())?;
        let [magic @ .., major, _minor] = fixed;
        if magic != *b"\x93NUMPY" {
            return Err("data without the .npy signature".to_owned());
        }
        let (field, text_length) = match major {
            1 => (2, u32::from(u16::from_le_bytes(bytes(&mut source)?))),
            2 | 3 => (4, u32::from_le_bytes(bytes(&mut source)?)),
            _ => return Err(format!(".npy format version {major}")),
        };
        if text_length as usize > MAX_HEADER_BYTES {
            return Err(format!("a header of {text_length} bytes"));
        }
        let mut text = vec![0; text_length as usize];
        source.read_exact(&mut text).map_err(|error| error.to_string())?;
        let text = String::from_utf8(text).map_err(|_| "a header that is not text".to_owned())?;
        let length = fixed.len() as u64 + field + u64::from(text_length);
        Dictionary(&text).header(length)
    }

    /// Number of items and of bytes; `None` if these overflow 64 bits.
    ///
    /// Dimensions of zero count as one in between, so that no partial product overflows.
    pub fn size(&self) -> Option<(usize, u64)> {
        let item = self.kind.num_bytes()?.max(1);
        self.shape.iter().try_fold(item, |product, &extent| product.checked_mul(extent.max(1)))?;
        let items = self.shape.iter().product::<usize>();
        Some((items, items as u64 * self.kind.num_bytes()? as u64))
    }
}

fn bytes<const N: usize>(source: &mut impl Read) -> Result<[u8; N], String> {
    let mut bytes = [0; N];
    source.read_exact(&mut bytes).map_err(|error| error.to_string())?;
    Ok(bytes)
}

/// The part of the header's text that is not yet parsed.
struct Dictionary<'a>(&'a str);

impl<'a> Dictionary<'a> {
    fn header(mut self, length: u64) -> Result<NpyHeader, String> {
        let (mut kind, mut fortran_order, mut shape) = (None, None, None);
        self.expect("{")?;
        while !self.take("}") {
            let key = self.text()?;
            self.expect(":")?;
            let repeated = match key {
                "descr" => kind.replace(self.kind()?).is_some(),
                "fortran_order" => fortran_order.replace(self.truth()?).is_some(),
                "shape" => shape.replace(self.shape()?).is_some(),
                _ => return Err(format!("a header with the entry '{key}'")),
            };
            if repeated {
                return Err(format!("a header with two entries '{key}'"));
            }
            if !self.take(",") {
                self.expect("}")?;
                break;
            }
        }
        match (kind, fortran_order, shape, self.0.trim_start()) {
            (Some(kind), Some(fortran_order), Some(shape), "") => {
                Ok(NpyHeader { kind, fortran_order, shape, length })
            }
            (.., "") => Err("a header without one of descr, fortran_order and shape".to_owned()),
            (.., rest) => Err(format!("'{}' after the header", beginning(rest))),
        }
    }

    fn take(&mut self, token: &str) -> bool {
        self.0 = self.0.trim_start();
        let rest = self.0.strip_prefix(token);
        self.0 = rest.unwrap_or(self.0);
        rest.is_some()
    }

    fn expect(&mut self, token: &str) -> Result<(), String> {
        if self.take(token) {
            return Ok(());
        }
        Err(format!("a header with '{}' where '{token}' should be", beginning(self.0)))
    }

    /// A quoted string without escapes.
    fn text(&mut self) -> Result<&'a str, String> {
        let quote = if self.take("\"") { '"' } else { '\'' };
        if quote == '\'' {
            self.expect("'")?;
        }
        let (text, rest) = self.0.split_once(quote).ok_or("a header that ends within quotes")?;
        self.0 = rest;
        Ok(text)
    }

    fn kind(&mut self) -> Result<TypeStr, String> {
        if self.take("[") {
            return Err("records".to_owned());
        }
        let text = self.text()?;
        let digits = text.trim_start_matches(['<', '>', '|']).get(1..).unwrap_or_default();
        let usual = digits.bytes().all(|byte| byte.is_ascii_digit());
        let kind = if usual { text.parse().ok() } else { None };
        kind.ok_or_else(|| format!("type {}", beginning(text)))
    }

    fn truth(&mut self) -> Result<bool, String> {
        if self.take("True") {
            return Ok(true);
        }
        self.expect("False").map(|()| false)
    }

    fn shape(&mut self) -> Result<Vec<usize>, String> {
        let mut shape = Vec::new();
        self.expect("(")?;
        while !self.take(")") {
            shape.push(self.extent()?);
            if !self.take(",") {
                self.expect(")")?;
                break;
            }
        }
        Ok(shape)
    }

    fn extent(&mut self) -> Result<usize, String> {
        let text = self.0.trim_start();
        let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
        let (digits, rest) = text.split_at(end);
        self.0 = rest;
        let number = if digits.is_empty() { beginning(rest) } else { beginning(digits) };
        digits.parse().map_err(|_| format!("a shape with the extent '{number}'"))
    }
}

/// The start of a text, for messages.
fn beginning(text: &str) -> String {
    text.chars().take(24).collect::<String>().escape_debug().to_string()
}
