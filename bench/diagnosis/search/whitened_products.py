"""Whitened inner products of residuals and directions, with fitted unknowns projected out.

The residual e, the directions D and the Jacobian J are whitened by W(phi), an AR(1) model, run by
run; phi is common to all channels. W'W is tridiagonal. With samples a_t, b_t of two columns, zero
where no sample exists, and n_t the number of missing neighbours of t,

    (W a)'(W b) = ((1 + phi^2) sum a_t b_t - phi sum a_t (b_t-1 + b_t+1) - phi^2 sum n_t a_t b_t)
                  / (1 - phi^2)                                                                (1)

Three sums of products therefore serve every phi; the last one needs only the ends of runs. The part
of the inner product of two columns a and b that parameters and initial states absorb is projected
out by a Schur complement, first for the initial states of each run, then for the parameters of all
runs (Frisch-Waugh-Lovell theorem). With L a root of the inverse, L L' = (J'J)^-1:

    <a, b> = a'b - (L'J'a)'(L'J'b)                                                             (2)

Directions are multiplied with each other only if they act together, so the cost is proportional to
the number of directions, samples and residuals.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from bench.diagnosis.evaluation.noise_model import Mask
from bench.diagnosis.evaluation.run_evaluator import Indices
from bench.diagnosis.fitting.levenberg_marquardt import TrajectoryFit
from sims.core.simulator import Array


class LaggedSums(NamedTuple):
    """The three sums of eq. (1), each an array of products.

    Attributes:
        same_samples: products of the samples at equal times, summed over time.
        neighbours: products of each sample with its two neighbours in time, summed.
        run_ends: products of samples without a neighbour, times the number of missing neighbours.
    """

    same_samples: Array
    neighbours: Array
    run_ends: Array

    @staticmethod
    def zeros(*shape: int) -> LaggedSums:
        """Return sums of zeros with the given shape."""
        return LaggedSums(np.zeros(shape), np.zeros(shape), np.zeros(shape))

    def combine(self, phi: float) -> Array:
        """Combine the three sums to the inner products (W a)'(W b) of whitened columns, eq. (1).

        A column is a signal over all samples, here a or b. W is the whitening by the AR(1)
        correlation phi. The product is

        ((1 + phi^2) sum a_t b_t - phi sum a_t (b_{t-1} + b_{t+1}) - phi^2 sum n_t a_t b_t) /
        (1 - phi^2),

        with n_t the number of missing neighbours of sample t. The three sums are `same_samples`,
        `neighbours` and `run_ends`.

        Args:
            phi: AR(1) correlation of the noise.
        """
        square = phi * phi
        scaled_products = (
            (1.0 + square) * self.same_samples - phi * self.neighbours - square * self.run_ends
        )
        products: Array = scaled_products / (1.0 - square)  # (1)
        return products


class RunSegment(NamedTuple):
    """A section of a run.

    Attributes:
        run: index of the run.
        begin: first sample.
        end: end of the samples (exclusive).
        edge_samples: (m,) indices of the samples that lack a neighbour in time, all channels in
            one row.
        missing_neighbours: (m,) number of missing neighbours (1 or 2) of each of these samples.
    """

    run: int
    begin: int
    end: int
    edge_samples: Indices
    missing_neighbours: Array


class SegmentColumns(NamedTuple):
    """Columns over a section of a run in sigmas, all channels in one row.

    Attributes:
        samples: (k, n) the samples.
        neighbour_sums: (k, n) sum of the previous and the next sample of each sample.
        edge_samples: (k, m) the samples that lack a neighbour.
    """

    samples: Array
    neighbour_sums: Array
    edge_samples: Array


def count_missing_neighbours(observed_mask: Mask) -> Array:
    """Count the missing neighbours in time of each available sample: n_t of eq. (1), (R, T, C).

    The first and the last sample of a run lack one neighbour each. AR(1) whitening uses the
    previous sample, so samples at the edges of gaps have other weights.

    Shapes: R runs, T samples, C channels.

    Args:
        observed_mask: (R, T, C) whether a sample exists.
    """
    missing_counts = np.full(observed_mask.shape, 2.0)
    missing_counts[:, 1:] -= observed_mask[:, :-1]
    missing_counts[:, :-1] -= observed_mask[:, 1:]
    # Missing samples count as zero: AR(1) noise restarts after a gap, because earlier noise is not
    # known.
    return np.where(observed_mask, missing_counts, 0.0)


def select_run(sums: LaggedSums, run: int) -> LaggedSums:
    """Return the sums of one run, as views to which products can be added."""
    return LaggedSums(*(values[run] for values in sums))


def add_cross_products(
    sums: LaggedSums, first: SegmentColumns, second: SegmentColumns, segment: RunSegment
) -> None:
    """Add the products of all columns of one set with all columns of another, over one segment.

    For columns a and b, these are three sums over the samples t of the segment: of a_t b_t, of
    a_t (b_t-1 + b_t+1), and of n_t a_t b_t with the number n_t of missing neighbours. The inner
    product of whitened columns follows from them for any correlation (eq. (1) of the module
    docstring).

    Args:
        sums: sums to add to, in place, (..., k, l) each.
        first: k columns of the first set.
        second: l columns of the second set.
        segment: section of a run, with its samples that lack neighbours.
    """
    sums.same_samples[...] += first.samples @ np.swapaxes(second.samples, -1, -2)
    # Summed over a run, sum a_t (b_t-1 + b_t+1) is symmetric in a and b.
    sums.neighbours[...] += first.samples @ np.swapaxes(second.neighbour_sums, -1, -2)
    sums.run_ends[...] += (first.edge_samples * segment.missing_neighbours) @ np.swapaxes(
        second.edge_samples, -1, -2
    )


def add_self_products(sums: LaggedSums, columns: SegmentColumns, segment: RunSegment) -> None:
    """Add the product of each column with itself, over one segment.

    For a column a, these are three sums over the samples t of the segment: of a_t^2, of
    a_t (a_t-1 + a_t+1), and of n_t a_t^2 with the number n_t of missing neighbours.

    Args:
        sums: sums to add to, in place, (k,) each.
        columns: k columns whose squares are summed.
        segment: section of a run, with its samples that lack neighbours.
    """
    sums.same_samples[...] += np.einsum("kn,kn->k", columns.samples, columns.samples)
    sums.neighbours[...] += np.einsum("kn,kn->k", columns.neighbour_sums, columns.samples)
    sums.run_ends[...] += np.einsum(
        "km,km,m->k", columns.edge_samples, columns.edge_samples, segment.missing_neighbours
    )


MIN_RESIDUAL_SHARE = 1e-12
"""Minimum share of the sum of squares of a direction that remains after the projection.

A direction with less is absorbed by parameters and initial states.
"""
RANK_TOLERANCE = 1e-9
"""Minimum eigenvalue of scaled products that counts, as a share of the largest eigenvalue."""
MAX_CHUNK_SIZE = 400_000
"""Maximum size of an array in one section, in numbers, so that it fits in the CPU cache."""
MIN_CHUNK_SAMPLES = 64
"""Minimum number of samples per section, so that the overhead of a section is small."""


class _ReducedDesign(NamedTuple):
    """A design after whitening and projection.

    Attributes:
        state_roots: (R, s, s) roots L of the inverse normal matrices of the initial states.
        state_projections: (R s, q + K) L'J'a of eq. (2) for the initial states, with the
            derivatives by the parameters and the directions as columns a.
        parameter_root: (q, q) root L for the parameters.
        parameter_projections: (q, K) L'J'a of eq. (2) for the parameters, with the directions as a.
        grams: for each block, products (n, k, k) of the directions that act together.
        acting: (K,) mask of directions that parameters and initial states do not absorb.
    """

    state_roots: Array
    state_projections: Array
    parameter_root: Array
    parameter_projections: Array
    grams: list[Array]
    acting: Mask


class WhiteningDesign:
    """Jacobian and directions of one model, as needed for products with any residuals.

    Attributes:
        blocks: as given.
    """

    def __init__(
        self,
        fit: TrajectoryFit,
        directions: Array,
        observed_mask: Mask,
        sigma: Array,
        blocks: Sequence[Indices],
    ) -> None:
        """Sum the products of Jacobian and directions over all samples, for all correlations.

        The sums have the three parts of eq. (1) and are combined for a given phi later. A *column*
        is a signal over all samples: a derivative or a direction. `_jacobian_products` has the
        products of the derivatives by the q parameters and s initial states with each other (R, q +
        s, q + s), `_direction_products` those with the K directions (R, q + s, K),
        `_direction_squares` (K,) the squares of the directions, and `_block_products` the products
        of directions that act together. `_missing_neighbours` (R, T, C) counts the missing
        neighbours of each sample, and `_reduced_designs` caches the projected design of each phi.

        Shapes: R runs, T samples, C channels.

        Args:
            fit: fit of the runs: parameters, initial states, simulated runs and derivatives.
            directions: (R, T, C, K) change of the runs by each direction.
            observed_mask: (R, T, C) mask of available samples.
            sigma: (C,) weights of the channels.
            blocks: arrays (n, k) of column indices; the directions in a row act together.
        """
        self.blocks = list(blocks)
        self._parameter_count = fit.free_indices.size
        self._jacobian = np.moveaxis(fit.jacobian, 3, 0)
        self._directions = np.moveaxis(directions, 3, 0)
        self._weights = observed_mask / sigma
        self._missing_neighbours = count_missing_neighbours(observed_mask)
        # q + s derivatives and K directions.
        size, runs, *_ = self._jacobian.shape
        count = len(self._directions)
        self._jacobian_products = LaggedSums.zeros(runs, size, size)
        self._direction_products = LaggedSums.zeros(runs, size, count)
        self._direction_squares = LaggedSums.zeros(count)
        self._block_products = [
            LaggedSums.zeros(*block.shape, block.shape[1]) for block in self.blocks
        ]
        self._reduced_designs: dict[float, _ReducedDesign] = {}
        for segment in self._iterate_sections():
            self._add_section_products(segment)

    def _iterate_sections(self) -> Iterator[RunSegment]:
        """Yield sections of the runs that are so short that their columns fit in the CPU cache.

        Sums over sections are several times faster than over whole runs. Each section has the
        indices of its samples with missing neighbours, at which whitening differs.
        """
        direction_count, runs, length, channels = self._directions.shape
        # Number of samples of a section.
        step = max(MAX_CHUNK_SIZE // (max(direction_count, 1) * channels), MIN_CHUNK_SAMPLES)
        for run in range(runs):
            for begin in range(0, length, step):
                end = min(begin + step, length)
                missing_neighbours = self._missing_neighbours[run, begin:end].ravel()
                edge = np.flatnonzero(missing_neighbours)
                yield RunSegment(run, begin, end, edge, missing_neighbours[edge])

    def _weight_columns(
        self, values: Array, segment: RunSegment, has_neighbours: bool = True
    ) -> SegmentColumns:
        """Return weighted samples of one section, and the sums of their two neighbours in time.

        Products of these give the sums of eq. (1): a_t b_t, a_t (b_t-1 + b_t+1), and a_t b_t at
        samples that lack a neighbour. The weights are 1 / sigma of each channel, and zero where no
        sample exists.

        Shapes: R runs, T samples, C channels.

        Args:
            values: (k, R, T, C) columns: derivatives, directions or residuals.
            segment: the section.
            has_neighbours: whether sums of neighbours are needed; otherwise they are zero.

        Returns:
            Columns (k, n) over the n = (end - begin) C samples of the section, all channels in one
            row.
        """
        run, begin, end = segment.run, segment.begin, segment.end
        column_count = len(values)
        # Include one more sample on either side, if it exists, as a neighbour of the outermost
        # ones.
        first, last = (max(begin - 1, 0), end + 1) if has_neighbours else (begin, end)
        # The slice may end beyond the run, which then has no further sample.
        extended_samples = values[:, run, first:last] * self._weights[run, first:last]
        samples = extended_samples[:, begin - first : end - first]
        neighbour_sums = np.zeros_like(samples)
        if has_neighbours:
            # Samples begin - 1 to end - 2. At the beginning of the run, sample begin - 1 does not
            # exist, so that the first sample gets nothing.
            previous_samples = extended_samples[:, : end - first - 1]
            lacking_count = samples.shape[1] - previous_samples.shape[1]
            neighbour_sums[:, lacking_count:] += previous_samples
            # Samples begin + 1 to end. At the end of the run, sample `end` does not exist, so that
            # the last sample gets nothing.
            next_samples = extended_samples[:, begin - first + 1 :]
            neighbour_sums[:, : next_samples.shape[1]] += next_samples
        # The shape is written out, because -1 is ambiguous if there are no rows.
        flat_shape = column_count, samples.shape[1] * samples.shape[2]
        flat = samples.reshape(flat_shape)
        return SegmentColumns(
            flat, neighbour_sums.reshape(flat_shape), flat[:, segment.edge_samples]
        )

    def _add_section_products(self, segment: RunSegment) -> None:
        """Add the products of one section of a run to the sums of eq. (1).

        1. The Jacobian with itself and with the directions, which the projection needs.
        2. The squares of the directions.
        3. The products of directions that act together (a block).

        Args:
            segment: section of a run, with its samples that lack neighbours.
        """
        # Samples of the section, divided by the noise.
        jacobian_columns = self._weight_columns(self._jacobian, segment)
        direction_columns = self._weight_columns(self._directions, segment)
        # 1. Jacobian.
        add_cross_products(
            select_run(self._jacobian_products, segment.run),
            jacobian_columns,
            jacobian_columns,
            segment,
        )
        add_cross_products(
            select_run(self._direction_products, segment.run),
            jacobian_columns,
            direction_columns,
            segment,
        )
        # 2. Squares.
        add_self_products(self._direction_squares, direction_columns, segment)
        # 3. Blocks.
        for block, block_sums in zip(self.blocks, self._block_products, strict=True):
            # A row of a block (n, k) has the indices of k directions. The square of a single one is
            # already known.
            if block.shape[1] > 1:
                members = SegmentColumns(
                    direction_columns.samples[block],
                    direction_columns.neighbour_sums[block],
                    direction_columns.edge_samples[block],
                )
                add_cross_products(block_sums, members, members, segment)

    def compute_products(self, *residuals: Array) -> tuple[LaggedSums, LaggedSums, LaggedSums]:
        """Compute products of residuals with themselves, with the Jacobian, and with directions.

        With the products of the design, they are all that scores need, for any correlation.

        Shapes: R runs, T samples, C channels, q fitted parameters, s states of a run.

        Args:
            *residuals: arrays (S_i, R, T, C) of residuals, which are concatenated to S residuals.

        Returns:
            Products of residuals with themselves (S,), with the Jacobian per run (R, q + s, S), and
            of the K directions with residuals (K, S). Each has the three sums of eq. (1), which
            are combined for a correlation later.
        """
        # q + s columns of the Jacobian, of the parameters and the initial states.
        unknown_count, runs, *_ = self._jacobian.shape
        residual_count = sum(len(array) for array in residuals)
        squares = LaggedSums.zeros(residual_count)
        shared = LaggedSums.zeros(runs, unknown_count, residual_count)
        cross = LaggedSums.zeros(len(self._directions), residual_count)
        for segment in self._iterate_sections():
            # Concatenate section by section, because whole copies would double the memory.
            parts = [self._weight_columns(array, segment) for array in residuals]
            residual_columns = SegmentColumns(
                *(np.concatenate(rows) for rows in zip(*parts, strict=True))
            )
            jacobian_columns = self._weight_columns(self._jacobian, segment)
            # Only the second factor of a product needs the sums of its neighbours.
            direction_columns = self._weight_columns(
                self._directions, segment, has_neighbours=False
            )
            add_self_products(squares, residual_columns, segment)
            add_cross_products(
                select_run(shared, segment.run), jacobian_columns, residual_columns, segment
            )
            add_cross_products(cross, direction_columns, residual_columns, segment)
        return squares, shared, cross

    def project_out(self, residuals: Array) -> Array:
        """Return what remains of residuals after a fit of parameters and initial states.

        The fit is linear least squares. Parameters are shared by all runs, and each run has its own
        initial states.

        1. Project the residuals on the derivatives by the initial states and the parameters.
        2. Solve for the parameters, then for the initial states of each run (back substitution).
        3. Subtract the fitted change from the residuals.

        Shapes: R runs, T samples, C channels.

        Args:
            residuals: (S, R, T, C) residuals before the fit.
        """
        # 1. Projections.
        # White noise: the fit weights the samples by the noise of their channel only.
        reduced_design = self.reduce(0.0)
        parameter_count = self._parameter_count
        weighted = self._jacobian * self._weights
        # Products (R, q + s, S) of the derivatives by q parameters and s initial states with the
        # residuals.
        shared = np.stack(
            [
                _flatten(run_jacobian) @ _flatten(residuals[:, run] * self._weights[run]).T
                for run, run_jacobian in enumerate(np.moveaxis(weighted, 1, 0))
            ]
        )
        by_states, by_parameters = _project_residuals(reduced_design, shared)
        # 2. Coefficients: parameters (q, S), and initial states (R, s, S).
        parameters = reduced_design.parameter_root @ by_parameters
        state_products = (
            by_states - reduced_design.state_projections[:, :parameter_count] @ parameters
        )
        runs, size, _ = reduced_design.state_roots.shape
        states = reduced_design.state_roots @ state_products.reshape(runs, size, len(residuals))
        # 3. Remaining residuals.
        result = np.empty_like(residuals)
        for run in range(runs):
            coefficients = np.concatenate([parameters, states[run]])
            explained_residuals = coefficients.T @ _flatten(self._jacobian[:, run])
            result[:, run] = residuals[:, run] - explained_residuals.reshape(
                residuals[:, run].shape
            )
        return np.where(self._weights > 0, result, 0.0)

    def reduce(self, phi: float) -> _ReducedDesign:
        """Return the whitened design with fitted unknowns projected out, eq. (2), for one phi.

        The result is cached.
        """
        if phi not in self._reduced_designs:
            self._reduced_designs[phi] = self._whiten_and_project(phi)
        return self._reduced_designs[phi]

    def _whiten_and_project(self, phi: float) -> _ReducedDesign:
        """Whiten the design with the correlation phi, and project it by eq. (2).

        The design has the derivatives by parameters and initial states (J) and the directions of
        effects. The product of two columns a and b becomes a'b - (L'J'a)'(L'J'b), eq. (2), with
        L L' = (J'J)^-1. So only the part of a direction that parameters and initial states cannot
        absorb remains.

        Shapes: R runs, q fitted parameters, s initial states of a run, K directions.

        1. Whiten all products with phi.
        2. Project out the initial states of each run, then the parameters of all runs.
        3. Mark the directions of which nothing remains.
        4. Project the products of directions that act together.

        Args:
            phi: AR(1) correlation of the noise.
        """
        # The first columns of the Jacobian are the parameters, the others the initial states.
        parameter_count = self._parameter_count
        # 1. Whitening.
        # Products J'J (R, q + s, q + s), those of J with the K directions (R, q + s, K), and the
        # sums of squares of the directions (K,).
        normal = self._jacobian_products.combine(phi)
        mixed = self._direction_products.combine(phi)
        squares = self._direction_squares.combine(phi)

        # 2. Projection: L'J'a of the initial states, then of the parameters. Initial states belong
        # to one run, parameters to all runs, so that products with parameters are summed over the
        # runs.
        state_root = _compute_matrix_root(normal[:, parameter_count:, parameter_count:])
        other_products = np.concatenate(
            [normal[:, parameter_count:, :parameter_count], mixed[:, parameter_count:]], axis=2
        )
        by_states = _project_directions(state_root, other_products)
        # L'J'a of the initial states, with the parameters and with the directions as columns a.
        by_parameters = by_states[:, :parameter_count]
        by_directions = by_states[:, parameter_count:]
        # Products of the derivatives by the parameters, without what initial states absorb (q, q).
        schur_complement = (
            normal[:, :parameter_count, :parameter_count].sum(axis=0)
            - by_parameters.T @ by_parameters
        )
        parameter_root = _compute_matrix_root(schur_complement)
        # L'J'a of the parameters, with the directions as columns a (q, K).
        by_own_parameters = parameter_root.T @ (
            mixed[:, :parameter_count].sum(axis=0) - by_parameters.T @ by_directions
        )

        # 3. Absorbed directions.
        # Only rounding remains of absorbed directions, which would explain residuals at random.
        # L'J'a of all initial states and parameters (R s + q, K), whose squares are absorbed.
        absorbed = np.concatenate([by_directions, by_own_parameters])
        remaining = squares - np.einsum("ak,ak->k", absorbed, absorbed)
        acting = remaining > MIN_RESIDUAL_SHARE * squares
        remaining = np.where(acting, remaining, 0.0)
        # 4. Blocks.
        grams = self._project_blocks(phi, absorbed, remaining, acting)
        return _ReducedDesign(
            state_root, by_states, parameter_root, by_own_parameters, grams, acting
        )

    def _project_blocks(
        self, phi: float, absorbed: Array, remaining: Array, acting: Mask
    ) -> list[Array]:
        """Return the products of directions that act together, without what a fit absorbs.

        A block is an array (n, k) of column indices: n groups of k directions that act together.
        The absorbed part of the product of two directions a and b is (L'J'a)'(L'J'b), eq. (2).

        Args:
            phi: AR(1) correlation of the noise.
            absorbed: (R s + q, K) L'J'a of the K directions a, for the s initial states of each of
                R runs and for q parameters.
            remaining: (K,) sum of squares of each direction that is not absorbed.
            acting: (K,) mask of the directions of which something remains.

        Returns:
            Products (n, k, k) of each block; zero for directions that are absorbed.
        """
        grams = []
        for block, block_sums in zip(self.blocks, self._block_products, strict=True):
            # A single direction has only its square.
            if block.shape[1] == 1:
                grams.append(remaining[block][:, :, None])
                continue
            # (n, k, R s + q)
            columns = np.moveaxis(absorbed[:, block], 0, 2)
            gram = block_sums.combine(phi) - columns @ columns.transpose(0, 2, 1)
            # Rounding makes the two halves differ, and the eigensolver reads only one of them.
            symmetric = (gram + gram.transpose(0, 2, 1)) / 2.0
            is_pair_acting = acting[block][:, :, None] & acting[block][:, None, :]
            grams.append(np.where(is_pair_acting, symmetric, 0.0))
        return grams


class InnerProducts:
    """Inner products, eq. (2), of residuals and directions, with fitted unknowns projected out.

    Args:
        design: the Jacobian of the model and the directions.
        *residuals: arrays (S_i, R, T, C) of residuals, zero where no sample exists.
    """

    def __init__(self, design: WhiteningDesign, *residuals: Array) -> None:
        self._design = design
        self._squares, self._shared, self._cross = design.compute_products(*residuals)

    def project(self, phi: float) -> tuple[Array, list[Array], Array]:
        """Return the products of eq. (2) for noise with the AR(1) correlation phi.

        The residuals and directions are whitened with phi, and the part that parameters and initial
        states absorb is removed: <a, b> = a'b - (L'J'a)'(L'J'b), eq. (2), with the Jacobian J and L
        L' = (J'J)^-1.

        Args:
            phi: AR(1) correlation of the noise.

        Returns:
            Sums of squares (S,) of the residuals, products (n, k, k) of the directions in each
            block, and products of directions with residuals (K, S).
        """
        reduced_design = self._design.reduce(phi)
        parameter_count = len(reduced_design.parameter_root)
        # L'J'e of the residuals e, for the initial states and the parameters.
        by_states, by_parameters = _project_residuals(reduced_design, self._shared.combine(phi))
        absorbed = np.concatenate([by_states, by_parameters])
        total = self._squares.combine(phi) - np.einsum("as,as->s", absorbed, absorbed)
        # L'J'd of the directions d; the first columns of `state_projections` are those of
        # parameters.
        direction_products = np.concatenate(
            [
                reduced_design.state_projections[:, parameter_count:],
                reduced_design.parameter_projections,
            ]
        )
        cross = self._cross.combine(phi) - direction_products.T @ absorbed
        # Rounding may make a sum of squares slightly negative; absorbed directions explain nothing.
        return (
            np.maximum(total, 0.0),
            reduced_design.grams,
            np.where(reduced_design.acting[:, None], cross, 0.0),
        )


def _flatten(values: Array) -> Array:
    """Reshape (k, T, C) to (k, T · C)."""
    return values.reshape(len(values), -1)


def _project_residuals(reduced_design: _ReducedDesign, shared: Array) -> tuple[Array, Array]:
    """Return L'J'e of S residuals e, for initial states (R s, S) and for parameters (q, S).

    L is a root of (J'J)^-1, with the Jacobian J. The squares of the results are the part of the sum
    of squares of e that initial states and parameters absorb, eq. (2) of the module docstring.

    Shapes: R runs, q fitted parameters, s states of a run.

    Args:
        reduced_design: Jacobian and directions after whitening and projection.
        shared: (R, q + s, S) products J'e of the Jacobian with the residuals.
    """
    parameter_count = len(reduced_design.parameter_root)
    # First the initial states of each run, then the parameters, with what the states leave.
    by_states = _project_directions(reduced_design.state_roots, shared[:, parameter_count:])
    parameter_products = (
        shared[:, :parameter_count].sum(axis=0)
        - reduced_design.state_projections[:, :parameter_count].T @ by_states
    )
    return by_states, reduced_design.parameter_root.T @ parameter_products


def _project_directions(roots: Array, products: Array) -> Array:
    """Multiply the products J'a of each run by the root L', for the projection of eq. (2).

    The projection subtracts (L'J'a)'(L'J'b), the part of a'b that the initial states absorb. J are
    the derivatives by the initial states.

    Shapes: R runs, s states of a run.

    Args:
        roots: (R, s, s) L of each run.
        products: (R, s, n) J'a of each run for n columns a.

    Returns:
        L'J'a of all runs, (R s, n).
    """
    runs, size, count = products.shape
    return (roots.transpose(0, 2, 1) @ products).reshape(runs * size, count)


def _compute_matrix_root(normal: Array) -> Array:
    """Return L with L L' = (J'J)^-1 of eq. (2), for positive semidefinite matrices (..., s, s).

    It is the root of a pseudoinverse: eigenvectors with very small eigenvalues, which rounding
    decides, are omitted.

    Args:
        normal: (..., s, s) matrices J'J of the normal equations.
    """
    # Without unknowns (s = 0), the root is empty, as the matrix is.
    if not normal.shape[-1]:
        return normal
    # Scale the columns to unit length, so that the cutoff does not depend on their units.
    squared_lengths = np.diagonal(normal, axis1=-2, axis2=-1)
    lengths = np.sqrt(np.maximum(squared_lengths, 0.0))
    # A row of zeros remains zero, because it is divided by infinity.
    scale = np.where(lengths > 0, lengths, np.inf)[..., None]
    eigenvalues, eigenvectors = np.linalg.eigh(normal / scale / np.swapaxes(scale, -1, -2))
    # Positive also for a matrix of zeros, of which no eigenvalue counts.
    largest = np.maximum(eigenvalues[..., -1:], 1e-300)
    is_counted = eigenvalues > RANK_TOLERANCE * largest
    inverse_roots = np.where(is_counted, 1.0 / np.sqrt(np.where(is_counted, eigenvalues, 1.0)), 0.0)
    root: Array = eigenvectors * inverse_roots[..., None, :] / scale
    return root
