//! The header of PAW setups in the XML format that GPAW and ABINIT share.

use atoms::Species;

/// Bytes of a file that contain the header.
const HEAD: usize = 8192;

/// Number of valence electrons of a PBE setup of this element, or what is wrong with the file.
pub(crate) fn valence(setup: &[u8], species: Species) -> Result<f64, String> {
    let head = String::from_utf8_lossy(&setup[..setup.len().min(HEAD)]);
    let valence = attribute(&head, "atom", "valence").and_then(|valence| valence.trim().parse::<f64>().ok());
    let functional = attribute(&head, "xc_functional", "name");
    match (attribute(&head, "atom", "symbol").map(str::trim), valence, functional) {
        (Some(symbol), Some(valence), Some(_)) if symbol == species.symbol() && valence >= 0.0 => {
            match functional.is_some_and(|name| ["PBE", "GGA_X_PBE+GGA_C_PBE"].contains(&name.trim())) {
                true => Ok(valence),
                false => {
                    Err(format!("is for the functional {}, not for PBE", functional.unwrap_or_default()))
                }
            }
        }
        _ => Err(format!(
            "is not a PAW setup of {species}: expected <atom symbol=\"{species}\" … valence=\"…\"/> and <xc_functional … \
             name=\"…\"/> at its beginning"
        )),
    }
}

/// `value` of `<element … key="value"`.
fn attribute<'a>(head: &'a str, element: &str, key: &str) -> Option<&'a str> {
    let attributes = head.split(&format!("<{element} ")).nth(1)?.split('>').next()?;
    attributes.split(&format!("{key}=\"")).nth(1)?.split('"').next()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_setup_is_of_its_element_and_of_pbe() {
        let iron = "Fe".parse().unwrap();
        let head = "<atom symbol=\"Fe\" Z=\"26.00\" core=\"10.00\" valence=\"16.00\"/>\n<xc_functional type=\"GGA\" name=\"PBE\"/>";
        assert_eq!(valence(head.as_bytes(), iron), Ok(16.0));
        assert!(
            valence(head.as_bytes(), "Co".parse().unwrap())
                .unwrap_err()
                .starts_with("is not a PAW setup of Co")
        );
        let other = head.replace("PBE", "PW");
        assert_eq!(valence(other.as_bytes(), iron), Err("is for the functional PW, not for PBE".into()));
        for end in 0..head.len() - 5 {
            assert!(valence(&head.as_bytes()[..end], iron).is_err(), "cut at {end}");
        }
    }
}
