//! Colours that remain distinguishable with colour blindness and in black-and-white print.

/// Red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Colour(pub u8, pub u8, pub u8);

/// Vermillion and blue are from Okabe and Ito (2008); they also differ in lightness.
impl Colour {
    /// Vermillion.
    pub const VERMILLION: Self = Self(0xd5, 0x5e, 0x00);
    /// Blue.
    pub const BLUE: Self = Self(0x00, 0x72, 0xb2);
    /// For text and axes.
    pub const INK: Self = Self(0x22, 0x22, 0x22);
    /// For guide lines.
    pub const GREY: Self = Self(0x80, 0x80, 0x80);
    /// The background.
    pub const WHITE: Self = Self(0xff, 0xff, 0xff);
}

/// A colour with opacity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Paint {
    /// The colour.
    pub colour: Colour,
    /// From 0 (invisible) to 1 (opaque).
    pub opacity: f64,
}

/// A line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Stroke {
    /// Its colour.
    pub paint: Paint,
    /// Its width, points.
    pub width: f64,
    /// Alternating lengths of dashes and gaps, points; empty for a solid line.
    pub dashes: &'static [f64],
}

impl From<Colour> for Paint {
    fn from(colour: Colour) -> Self {
        Self { colour, opacity: 1.0 }
    }
}

impl Colour {
    /// The colour with this opacity.
    pub fn faint(self, opacity: f64) -> Paint {
        Paint { colour: self, opacity }
    }

    /// A solid line.
    pub fn line(self, width: f64) -> Stroke {
        Stroke { paint: self.into(), width, dashes: &[] }
    }

    /// A dashed line.
    pub fn dashed(self, width: f64) -> Stroke {
        Stroke { paint: self.into(), width, dashes: &[3.0, 2.0] }
    }
}
