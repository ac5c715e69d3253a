"""The contract of a regulariser: a strictly convex quadratic of the decision, for every dictionary."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csc_array, eye_array, issparse, kron

from sparserob_core.sip.convex_set import Array
from sparserob_core.sip.convexity import ControlImage, Regulariser
from sparserob_core.sip.program import SemiInfiniteProgram
from sparserob_core.testing.contract import Contract, broken, demand, same

CURVATURE = 1e-10  # the smallest eigenvalue of P, as a share of the largest
SIZES = (1e-9, 1e9)  # of the largest eigenvalue of P
VALUE = 0.4  # of `two_thrusters`


def images() -> list[ControlImage]:
    """Return images of one to three channels, with pieces of equal and of different lengths, and with as many functions
    as pieces or fewer."""
    haar = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 0, 0]], dtype=float)
    uneven = np.array([0.5, 0.1, 0.3, 0.1, 2.0])
    return [
        ControlImage(csc_array(np.eye(1)), 1, np.ones(1)),
        ControlImage(csc_array(np.eye(20)), 1, np.full(20, 0.25)),
        ControlImage(csc_array(np.eye(10)), 2, np.tile(uneven, 2)),
        ControlImage(csc_array(kron(eye_array(2), haar.T)), 2, np.full(8, 0.5)),
        ControlImage(csc_array(kron(eye_array(3), np.ones((4, 1)))), 3, np.full(12, 100.0)),
    ]


def two_thrusters() -> SemiInfiniteProgram:
    """minimise ``|x|_1 / 10`` subject to ``sum x >= 4`` and ``|x| <= 1``, for 20 numbers: 0.4, of many optimisers."""
    return SemiInfiniteProgram(
        n=20, weights=0.1, lower=-1.0, upper=1.0, G=-np.ones((1, 20)), h=np.array([-4.0]), lengths=np.full(20, 0.1)
    )


class RegulariserContract(Contract[Regulariser], kind="regulariser"):
    """Contract of a regulariser: subclass it as ``class TestMine(RegulariserContract)`` and give ``component``.

    ``quadratic(image)`` returns ``P (n, n)``, sparse, symmetric and positive definite, and ``q (n,)``, of
    ``rho(x) = 1/2 x'P x + q'x``, where ``n`` is the number of columns of ``image.S``. The image gives the meaning of a
    decision: ``S x`` is the control on each piece, channel by channel, and ``lengths`` are the lengths of the pieces.
    """

    def quadratic(self, regulariser: Regulariser, image: ControlImage) -> tuple[csc_array, Array]:
        """``P`` and ``q``; a broken contract where something else comes back, or something is raised."""
        where = f"an image with {image.channels} channels of {image.pieces} pieces and {image.S.shape[1]} coefficients"
        try:
            answer: object = regulariser.quadratic(image)
        except Exception as error:  # noqa: BLE001  a component may raise anything, and must not
            broken(
                f"quadratic raised {type(error).__name__}: {error} for {where}",
                "take every size from the image: `image.S.shape[1]`, `image.channels`, `image.pieces`",
            )
        if not (isinstance(answer, tuple) and len(answer) == 2):
            broken(f"quadratic returned {type(answer).__name__} for {where}", "return the pair `P, q`")
        P, q = answer[0], np.asarray(answer[1])
        n = image.S.shape[1]
        demand(
            issparse(P) and P.shape == (n, n) and q.shape == (n,),
            f"quadratic returned P of shape {np.shape(P)} ({type(P).__name__}) and q of shape {q.shape} for {where}",
            f"return `scipy.sparse.csc_array` of shape ({n}, {n}) and an array of shape ({n},) there",
        )
        demand(
            np.isfinite(P.data).all() and q.dtype.kind in "fiu" and np.isfinite(q).all(),
            f"quadratic returned numbers that are not finite for {where}",
            "look for a division by a length, or by a difference of two",
        )
        return P, q

    def test_it_is_strictly_convex(self) -> None:
        for image in images():
            dense = self.quadratic(self.create(), image)[0].toarray()
            demand(
                np.abs(dense - dense.T).max() <= 1e-12 * np.abs(dense).max(),
                f"P is not symmetric: it differs from its transpose by {np.abs(dense - dense.T).max():.1e}",
                "return `(P + P.T) / 2`, which is the same quadratic",
            )
            curvature = np.linalg.eigvalsh((dense + dense.T) / 2)
            demand(
                curvature[0] > CURVATURE * max(curvature[-1], 0.0),
                f"P has the eigenvalues {curvature[0]:.3g} to {curvature[-1]:.3g}: it is not positive definite",
                "add a small multiple of the identity: only a strictly convex term makes the optimiser unique",
            )

    def test_it_is_of_ordinary_size(self) -> None:
        for image in images():
            P, q = self.quadratic(self.create(), image)
            size = float(np.linalg.eigvalsh(P.toarray())[-1])
            demand(
                SIZES[0] <= size <= SIZES[1] and np.abs(q).max() <= SIZES[1],
                f"P has the largest eigenvalue {size:.1e}, and q the largest entry {np.abs(q).max():.1e}",
                "the weight of the regulariser is the method's, from `continuation.start` downwards: state the term "
                "itself in the units of the control and of time",
            )

    def test_the_same_image_gives_the_same_term_whatever_came_before(self) -> None:
        regulariser = self.create()
        for image in [*images(), *images()]:
            P, q = self.quadratic(regulariser, image)
            fresh, p = self.quadratic(self.create(), image)
            demand(
                same(P.toarray(), fresh.toarray()) and same(q, p),
                "an old regulariser and a new one give different terms for one image",
                "keep nothing between calls of `quadratic`, and use no random numbers",
            )

    def test_the_image_is_left_as_it_was(self) -> None:
        for image, before in zip(images(), images(), strict=True):
            self.quadratic(self.create(), image)
            demand(
                same(image.S.toarray(), before.S.toarray()) and same(image.lengths, before.lengths),
                "quadratic has written into the image",
                "make a new matrix; `image.S.data` and `image.lengths` are shared",
            )

    def test_every_control_is_regularised(self) -> None:
        for image in images():
            n = image.S.shape[1]
            dense = self.quadratic(self.create(), image)[0].toarray()
            bare = [k for k in range(n) if not dense[k, k] > 0.0]
            demand(
                not bare,
                f"coefficient {bare[0] if bare else ''} of {n} is not regularised",
                "rows of S are channel by channel: repeat weights with `np.repeat(weights, image.pieces)`",
            )

    def test_the_cost_that_is_reached_is_that_without_it(self) -> None:
        from sparserob_core.experiment.run.solve import solve

        result = solve(two_thrusters(), regulariser=self.create())
        demand(
            result.status == "certified" and abs(result.cost - VALUE) <= 1e-6,
            f"with it the exchange method ends with {result.status} and the cost {result.cost:.9g}, where {VALUE} is "
            f"the optimum ({result.message})",
            "see that P and q are of ordinary size: their weight goes to zero, but has to start somewhere",
        )
