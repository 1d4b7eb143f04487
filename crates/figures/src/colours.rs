//! Colours that remain distinguishable with colour blindness and in black-and-white print.

/// Red, green and blue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Colour(pub u8, pub u8, pub u8);

/// Vermillion, blue and those beside them are from Okabe and Ito (2008); the first two also differ in lightness.
impl Colour {
    /// Vermillion.
    pub const VERMILLION: Self = Self(0xd5, 0x5e, 0x00);
    /// Blue.
    pub const BLUE: Self = Self(0x00, 0x72, 0xb2);
    /// Bluish green.
    pub const GREEN: Self = Self(0x00, 0x9e, 0x73);
    /// Orange.
    pub const ORANGE: Self = Self(0xe6, 0x9f, 0x00);
    /// Reddish purple.
    pub const PURPLE: Self = Self(0xcc, 0x79, 0xa7);
    /// Sky blue.
    pub const SKY: Self = Self(0x56, 0xb4, 0xe9);
    /// Colours of curves, in order.
    pub const SERIES: [Self; 6] =
        [Self::BLUE, Self::VERMILLION, Self::GREEN, Self::ORANGE, Self::PURPLE, Self::SKY];
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
