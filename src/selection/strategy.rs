//! Strategies and their names.

use std::str::FromStr;

/// How structures are picked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Strategy {
    /// Largest γ first, with an update of a copy of the mixture after each pick.
    Greedy,
    /// Farthest points over the atoms within the window, whitened by the mixture.
    FarthestPoints,
    /// Farthest points over all atoms and plain features.
    FarthestPointsAll,
    /// Largest gain in the information of the atoms within the window.
    DOptimal,
    /// Uniformly at random.
    Random,
    /// Uniformly at random among structures with an atom within the window.
    RandomExtrapolating,
}

/// A strategy and how many structures it picks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StrategyQuota {
    pub strategy: Strategy,
    /// `None`: all that a greedy selection finds.
    pub number: Option<usize>,
}

impl Strategy {
    /// Every strategy with its names, the first of which is written.
    const NAMES: [(Self, &[&str]); 6] = [
        (Self::Greedy, &["greedy"]),
        (Self::FarthestPoints, &["fps", "fps-extrap"]),
        (Self::FarthestPointsAll, &["fps-all"]),
        (Self::DOptimal, &["d-optimal"]),
        (Self::Random, &["random", "random-all"]),
        (Self::RandomExtrapolating, &["random-extrap"]),
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        let found = Self::NAMES.into_iter().find(|(strategy, _)| *strategy == self);
        found.and_then(|(_, names)| names.first().copied()).unwrap_or_default()
    }

    /// What it does with the statistics of the mixture, if it needs them.
    pub fn use_of_statistics(self) -> Option<&'static str> {
        match self {
            Self::Greedy => Some("updates"),
            Self::DOptimal => Some("starts from"),
            Self::FarthestPoints | Self::FarthestPointsAll | Self::Random | Self::RandomExtrapolating => None,
        }
    }
}

impl FromStr for StrategyQuota {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (name, number) = match text.split_once(':') {
            Some((name, number)) => (name, Some(number)),
            None => (text, None),
        };
        let known = Strategy::NAMES.into_iter().find(|(_, names)| names.contains(&name));
        let (strategy, _) = known.ok_or_else(|| {
            let names: Vec<_> = Strategy::NAMES.iter().map(|(strategy, _)| strategy.name()).collect();
            format!("unknown strategy '{name}'; expected one of {}, such as fps:25", names.join(", "))
        })?;
        let number = number.map(|number| match number.parse() {
            Ok(0) | Err(_) => Err(format!("'{number}' structures; expected a number above 0, as in fps:25")),
            Ok(number) => Ok(number),
        });
        Ok(Self { strategy, number: number.transpose()? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn strategies_have_names_and_numbers() {
        let part = |text: &str| text.parse::<StrategyQuota>();
        assert_eq!(part("greedy"), Ok(StrategyQuota { strategy: Strategy::Greedy, number: None }));
        assert_eq!(
            part("fps-extrap:25"),
            Ok(StrategyQuota { strategy: Strategy::FarthestPoints, number: Some(25) })
        );
        assert_eq!(part("d-optimal:9"), Ok(StrategyQuota { strategy: Strategy::DOptimal, number: Some(9) }));
        for (strategy, names) in Strategy::NAMES {
            assert!(names.iter().all(|name| part(name).unwrap().strategy == strategy));
        }
        for (wrong, why) in
            [("gredy", "random-extrap"), ("fps:0", "above 0"), ("fps:", "above 0"), ("", "greedy")]
        {
            assert!(part(wrong).unwrap_err().contains(why), "{wrong}");
        }
    }
}
