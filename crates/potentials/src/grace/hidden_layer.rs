//! The last hidden layer of the readout as features: the numbers in which the energy is linear.

use super::batch_passes::Energies;
use super::batches::Placed;
use super::chunked_slices::{ChunkedSlice, PlaceLayout, SharedSlice};
use super::evaluate::{Evaluator, PullBack};
use super::instructions::SimdPass;
use super::readout::{Readout, ReadoutWork};
use super::scratch::lock_scratch;
use super::vector::Vector;

/// What is done with a batch whose energies have just been computed.
struct HiddenLayer<'a, V> {
    readout: &'a Readout<V>,
    placed: Placed,
    /// Receives the numbers, `[atoms, D_h]`.
    values: &'a mut [f64],
    /// Their cotangent, `[atoms, D_h]`; empty if only the numbers are needed.
    cotangent: &'a [f64],
    /// Receives the cotangents of the densities.
    of_densities: &'a mut [V],
    work: &'a mut ReadoutWork<V>,
}

impl<V: Vector> SimdPass for HiddenLayer<'_, V> {
    #[inline(always)]
    fn run(self, _: bool) {
        let Self { readout, placed, values, cotangent, of_densities, work } = self;
        readout.hidden(&placed.batch, values, work);
        if !cotangent.is_empty() {
            readout.hidden_backward(&placed.batch, cotangent, work);
            readout.density_cotangents(of_densities, work);
        }
    }
}

impl<V: Vector> Evaluator<V> {
    /// As [`super::Grace::hidden_layer`].
    pub fn hidden_layer(&mut self, out: &mut Vec<f64>) {
        let width = self.network.readout.hidden_dimension();
        let mut values = Vec::new();
        self.threads.clone().run(|| self.read_out_hidden(&mut values, &[]));
        out.clear();
        out.resize(values.len(), 0.0);
        for (atom, row) in self.batches.order.iter().zip(values.chunks_exact(width)) {
            out[*atom as usize * width..][..width].copy_from_slice(row);
        }
    }

    /// As [`super::Grace::pull_back_hidden_layer`].
    pub fn pull_back_hidden_layer(&mut self, cotangent: &[f64], pull_back: &mut PullBack) {
        let (width, n) = (self.network.readout.hidden_dimension(), self.batches.order.len());
        assert_eq!(cotangent.len(), n * width, "a cotangent for every number of the hidden layer");
        let rows = self.batches.order.iter().map(|atom| &cotangent[*atom as usize * width..][..width]);
        let in_order = rows.collect::<Vec<_>>().concat();
        let of_energy = self.density_cotangents.clone();
        self.begin_derivatives();
        let layers = if n == 0 { 0 } else { self.layers.len() };
        self.threads.clone().run(|| {
            self.read_out_hidden(&mut Vec::new(), &in_order);
            self.backward_layers::<1>(layers);
        });
        self.density_cotangents = of_energy;
        self.scatter_gradient(0, pull_back);
    }

    /// The numbers of all atoms, and with a cotangent the cotangents of their densities; both in evaluation order.
    fn read_out_hidden(&mut self, values: &mut Vec<f64>, cotangent: &[f64]) {
        let Self { network, instructions, batches, layers, scratch, .. } = self;
        let (readout, width) = (&network.readout, network.readout.hidden_dimension());
        let per_atom = readout.blocks.len() * readout.density_lanes();
        values.resize(batches.order.len() * width, 0.0);
        let even = |of_one, numbers| ChunkedSlice::new(PlaceLayout::Even(of_one), 0, numbers);
        let of_densities =
            ChunkedSlice::new(PlaceLayout::Even(per_atom), 0, &mut self.density_cotangents[..]);
        let work = (even(1, &mut self.energies[..]), (even(width, &mut values[..]), of_densities));
        let cotangents = SharedSlice::new(width, 0, cotangent);
        self.threads.for_each_chunk(&batches.chunks, work, &|chunk, (mut energies, work), thread| {
            let (mut values, mut of_densities) = work;
            let work = &mut lock_scratch(scratch, thread).readout;
            for batch in chunk.batches.clone() {
                let placed = batches.placed(batch, *instructions);
                let places = placed.places();
                let basis = |k: usize| layers[k].trace.bases(&network.layers[k]).slice(&places);
                let (energies, of_densities) = (energies.slice(&places), of_densities.slice(&places));
                let (values, cotangent) = (values.slice(&places), cotangents.slice(&places));
                let cotangents = &mut *of_densities;
                instructions.run(Energies { readout, placed, basis, energies, cotangents, work });
                instructions.run(HiddenLayer { readout, placed, values, cotangent, of_densities, work });
            }
        });
    }
}
