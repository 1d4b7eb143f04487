//! Graph operations that only three-layer models use.

use super::equivariant_norm::EquivariantNorm;
use super::error::{GraceError, mismatch};
use super::graph::Graph;
use super::linear::{Linear, LinearPart};
use super::tape::{TapeOperation, Tensor};
use super::vector::{Vector, to_lanes};
use super::weight_map::{WeightBlock, WeightMap};

impl<V: Vector> Graph<'_, V> {
    /// The product of left and right after mixing their channels with the weights U and V of each component's
    /// group.
    pub fn mixed_product(&mut self, name: &str, left: Tensor, right: Tensor) -> Result<Tensor, GraceError> {
        let archive = self.archive;
        let key = |suffix: &str| format!("{name}_{suffix}");
        let left = self.mixed(name, left, ["U", "norm_u", "left"])?;
        let right = self.mixed(name, right, ["V", "norm_v", "right"])?;
        let out = self.coupled(name, name, "cg", [left, right])?;
        archive.expect_count(&key("nfunc"), out.components)?;
        for suffix in ["out_l", "out_parity"] {
            let labels = archive.integers(&key(suffix))?.data.len();
            if labels != out.components {
                let expected = format!("a list of {}", out.components);
                return Err(mismatch(archive, &key(suffix), format!("a list of {labels}"), expected));
            }
        }
        Ok(out)
    }

    /// Σ_n W_g(w),k,n x_n,w
    fn mixed(
        &mut self,
        name: &str,
        tensor: Tensor,
        [matrix, norm, side]: [&str; 3],
    ) -> Result<Tensor, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("{name}_{suffix}"));
        let rank = archive.count(&key("rank"), 1, 4096)?;
        let n_groups = archive.count(&key(&format!("n_groups_{side}")), 1, 1 << 16)?;
        archive.expect_count(&key(&format!("n_{side}")), tensor.channels)?;
        let channels = tensor.channels;
        self.weights.read_exactly(archive, &key(matrix), &[n_groups, rank, channels])?;
        let groups = archive.exactly_indices(&key(&format!("group_{side}")), tensor.components, n_groups)?;
        let norm = archive.scalar(&key(norm))?;
        let out = self.push(&format!("{name} {side}"), tensor.components, rank)?;
        let mut parts = Vec::new();
        for group in 0..n_groups {
            let rows: Vec<usize> = (0..groups.len()).filter(|w| groups[*w] == group).collect();
            let rows = rows.iter().map(|w| (tensor.row(*w) as u32, out.row(*w) as u32)).unzip();
            let block = WeightBlock {
                array: key(matrix),
                norm,
                factor: 1.0,
                first: group * rank * channels,
                strides: [0, 1, channels],
                inputs: [0, channels],
                outputs: [0, rank],
            };
            let map =
                WeightMap { types: 1, inputs: channels, outputs: rank, identity: 0.0, blocks: vec![block] };
            parts.push(LinearPart::new(map, &self.weights, rows));
        }
        parts.retain(|part| !part.tape[0].is_empty());
        self.operations.push(TapeOperation::Linear(Linear { parts }));
        Ok(out)
    }

    /// Applies the norm `name` to a tensor.
    pub fn equivariant_norm(&mut self, name: &str, from: Tensor) -> Result<Tensor, GraceError> {
        let (archive, key) = (self.archive, |suffix: &str| format!("{name}_{suffix}"));
        let ([groups, channels], weights) = self.weights.read(archive, &key("affine_weight"))?;
        if channels != from.channels {
            let found = format!("{channels} columns wide");
            return Err(mismatch(
                archive,
                &key("affine_weight"),
                found,
                format!("{} channels", from.channels),
            ));
        }
        let expand = archive.exactly_indices(&key("expand_index"), from.components, groups)?;
        let affine =
            expand.iter().flat_map(|g| to_lanes(&weights[g * channels..(g + 1) * channels])).collect();
        let invariant = archive.floats(&key("l0_mask"), &[from.components])?;
        if invariant.iter().any(|x| *x != 0.0 && *x != 1.0) {
            return Err(mismatch(archive, &key("l0_mask"), format!("{invariant:?}"), "zeros and ones"));
        }
        let centring = f64::from(u8::from(archive.count(&key("center_l0"), 0, 1)? == 1));
        let floor = archive.scalar(&key("eps"))?;
        if !(1e-30..=1.0).contains(&floor) {
            return Err(mismatch(archive, &key("eps"), floor.to_string(), "a number from 1e-30 to 1"));
        }
        let degree_weights = archive.floats(&key("degree_weights"), &[from.components])?;
        if let Some(negative) = degree_weights.iter().find(|d| **d < 0.0) {
            let found = format!("partly {negative}");
            return Err(mismatch(archive, &key("degree_weights"), found, "numbers not below zero"));
        }
        let to = self.push(name, from.components, channels)?;
        self.operations.push(TapeOperation::EquivariantNorm(EquivariantNorm {
            from,
            to,
            centred: invariant.iter().map(|x| x * centring).collect(),
            degree_weights,
            affine,
            floor,
        }));
        Ok(to)
    }
}
