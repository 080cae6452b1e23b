"""The example's numbers, each recomputed here by other means, and Figures 2 and 3 as files."""

import csv
import struct

import numpy as np
import pytest
from matplotlib import image

import gsisio_jax as gx
from gsisio_jax import Interval
from gsisio_jax.examples import paper
from gsisio_jax.paper import example, figures
from gsisio_jax.paper.reproduce import FILES, reproduce

# Typed from the section "Illustrative Example", epsilon = 0.
PRINTED = {
    "rk(H)": "1",
    **dict(zip(("a^f_11", "a^f_12", "a^f_21", "a^f_22"), ("0.38", "-0.52", "-0.2", "-0.14"), strict=True)),
    **dict(zip(("b^f_11", "b^f_12", "b^f_21", "b^f_22"), ("0.82", "0.21", "-0.2", "-0.14"), strict=True)),
    **dict(zip(("a^g_11", "a^g_12", "a^g_21", "a^g_22"), ("-0.04", "0.49", "-1", "0"), strict=True)),
    **dict(zip(("b^g_11", "b^g_12", "b^g_21", "b^g_22"), ("0.44", "0.81", "1", "0"), strict=True)),
    "L_f": "0.35",
    "L_g": "0.74",
    **dict(zip(("K_11", "K_12", "K_13", "K_14"), ("0.0267", "0", "0.0666", "0.1061"), strict=True)),
    **dict(zip(("K_21", "K_22", "K_23", "K_24"), ("0.4177", "2.1203", "1.0817", "2.0209"), strict=True)),
    **dict(zip(("L_11", "L_12", "L_13", "L_14"), ("0", "0.1017", "0", "0"), strict=True)),
    **dict(zip(("L_21", "L_22", "L_23", "L_24"), ("0.5194", "1.1814", "1.2787", "1.9302"), strict=True)),
    "rk(I-K1-L1)": "2",
    "rk(I-K1+L1)": "2",
    **dict(zip(("C_f_11", "C_f_12", "C_f_21", "C_f_22"), ("0.251", "0", "0.0029", "0.201"), strict=True)),
    **dict(zip(("C_g_11", "C_g_12", "C_g_21", "C_g_22"), ("0", "0.225", "-0.374", "-0.045"), strict=True)),
    "L_fd": "0.852",
    "L_gd": "1.19",
    "calligraphic L": "0.643",
}
WRONG = {
    "a^f_12", "L_f", "L_g", "rk(I-K1+L1)", "L_fd", "L_gd", "calligraphic L",
    *(f"K_{i}{j}" for i in (1, 2) for j in (1, 2, 3, 4) if (i, j) != (1, 2)),
    *(f"L_{i}{j}" for i in (1, 2) for j in (1, 2, 3, 4) if (i, j) not in ((1, 1), (1, 4))),
    *(f"C_{q}_{i}{j}" for q in "fg" for i in (1, 2) for j in (1, 2)),
}  # fmt: skip
STEPS = 20


@pytest.fixture(scope="module")
def found():
    return reproduce(steps=STEPS)


@pytest.fixture(scope="module")
def files(found, tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    for name, write in found.writers().items():
        write(folder / name)
    return folder


def test_every_printed_number_has_a_row_with_a_verdict(found):
    assert {row.name: row.printed for row in found.rows} == PRINTED
    assert len(found.rows) == len(PRINTED) == 48
    assert {row.name for row in found.rows if not row.agrees} == WRONG
    for row in found.rows:
        assert row.agrees == (row.reason == "") == (row.finding == "")
        assert row.agrees or row.finding in example.FINDINGS
    assert list(example.FINDINGS) == [f"P{i}" for i in range(1, 14)]


def test_computed_numbers_by_other_means(found):
    """The Jacobian by hand: f is affine but for cos c in [-1, 1], g but for two cosines; norms are largest at +-1."""
    value = {row.name: row.computed for row in found.rows}

    def matrix(name, columns):
        return np.array([[value[f"{name}_{i}{j}"] for j in range(1, columns + 1)] for i in (1, 2)])

    df = np.array([[[0.6 - 0.22 * c, -0.12 + 0.33 * c], [-0.2, -0.14]] for c in (-1, 1)])
    dg = np.array([[[0.2 + 0.24 * c, 0.65 + 0.16 * c], [e, 0]] for c in (-1, 1) for e in (-1, 1)])
    gain = {}
    for q, jacobians in (("f", df), ("g", dg)):
        a, b = jacobians.min(0), jacobians.max(0)
        np.testing.assert_allclose(matrix(f"a^{q}", 2), a, atol=1e-12)
        np.testing.assert_allclose(matrix(f"b^{q}", 2), b, atol=1e-12)
        C = np.where((a < 0) & (b > 0), np.minimum(-a, b), 0)
        np.testing.assert_allclose(matrix(f"C_{q}", 2), C, atol=1e-12)
        largest = max(np.linalg.norm(jacobian, 2) for jacobian in jacobians)
        assert value[f"L_{q}"] == pytest.approx(largest, rel=1e-9)
        gain[q] = largest + 2 * np.linalg.norm(C, 2)
        assert value[f"L_{q}d"] == pytest.approx(gain[q], rel=1e-9)
    J = np.linalg.pinv(np.vstack([paper.G, paper.H]))
    total, signed = np.abs(paper.G) @ np.abs(J), paper.G @ J
    np.testing.assert_allclose(matrix("K", 4), (total + signed) / 2, atol=1e-12)
    np.testing.assert_allclose(matrix("L", 4), (total - signed) / 2, atol=1e-12)
    eye = np.eye(2)
    for name, square in (("rk(I-K1-L1)", eye - total[:, :2]), ("rk(I-K1+L1)", eye - signed[:, :2])):
        assert value[name] == (np.linalg.svd(square, compute_uv=False) > 1e-9).sum()
    T_f = np.linalg.solve(eye - total[:, :2], eye - signed[:, :2])
    T_g = np.linalg.solve(eye - total[:, :2], total[:, 2:])
    contraction = gain["f"] * np.linalg.norm(T_f, 2) + gain["g"] * np.linalg.norm(T_g, 2)
    assert value["calligraphic L"] == pytest.approx(contraction, rel=1e-9)


def test_reasons_quote_what_the_printed_numbers_give(found):
    """P12: .8521, 1.496, 3.243, and .74 + 2 (.225) = 1.19; the norm of dg is above .74 at most states."""
    reason = {row.name: row.reason for row in found.rows}
    assert "0.8521" in reason["L_fd"]
    assert "1.496" in reason["L_gd"]
    assert "0.74 + 2 (0.225)" in reason["L_gd"]
    assert "3.243" in reason["calligraphic L"]
    c, e = np.meshgrid(*[np.cos(np.linspace(0, 2 * np.pi, 60))] * 2)
    dg = np.moveaxis(np.array([[0.2 + 0.24 * c, 0.65 + 0.16 * c], [e, 0 * e]]), (0, 1), (2, 3))
    assert (np.linalg.norm(dg, 2, axis=(2, 3)) > 0.74).mean() > 0.6


def test_the_printed_recursion_crosses_and_the_current_form_holds(found):
    printed, current = found.printed, found.current
    assert len(printed.x) == STEPS + 1
    assert figures.crossed(printed.state)[1:].all()
    assert figures.crossed(printed.input).all()
    assert (np.linalg.norm(printed.state.width, axis=1)[1:] > printed.state_bound[1:]).all()
    # By hand: Lemma 5 with the printed .643, from the width of the printed initial box.
    first, second = printed.state_bound[:2]
    assert first == pytest.approx(3.1 * np.sqrt(2))
    assert printed.state_bound[2] - 0.643 * second == pytest.approx(second - 0.643 * first)
    assert not figures.crossed(current.state).any()
    for truth, box in ((current.x, current.state), (current.d, current.input)):
        assert ((box.lower - 1e-9 <= truth) & (truth <= box.upper + 1e-9)).all()
    np.testing.assert_array_equal(current.d, example.record(STEPS).d[:-1])
    np.testing.assert_allclose(found.record.d[3], [2 * np.sin(0.6), 1.5 * np.cos(0.39)])
    speaks = ~current.silent
    assert speaks.sum() >= STEPS - 3
    assert found.certificate.self_consistent
    width, of_input = (np.linalg.norm(box.width, axis=1) for box in (current.state, current.input))
    assert (width[speaks] <= current.state_bound[speaks] + 1e-9).all()
    assert (of_input[speaks[1:]] <= current.input_bound[speaks[1:]] + 1e-9).all()
    limit = np.linalg.norm(found.certificate.steady_width)
    assert current.state_bound[-1] == pytest.approx(limit, rel=1e-3)
    facts = dict(found.facts())
    assert "20 of 48" in facts["numbers"]
    assert f"{STEPS} of {STEPS} state boxes crossed, the first at k = 1" in facts["as printed"]
    assert (
        f"{STEPS} of {STEPS} state and {STEPS - 1} of {STEPS - 1} input boxes hold the truth" in facts["current form"]
    )


def test_a_box_that_misses_is_reported(found):
    moved = found.current._replace(x=found.current.x + 100)
    assert (
        f"0 of {STEPS} state and {STEPS - 1} of {STEPS - 1} input boxes hold"
        in dict(found._replace(current=moved).facts())["current form"]
    )


def test_files(files, found):
    assert sorted(path.name for path in files.iterdir()) == sorted(FILES)
    for name in FILES[1:]:
        content = (files / name).read_bytes()
        assert content.startswith(b"\x89PNG")
        width, height = struct.unpack(">II", content[16:24])
        assert width > 1000
        assert height > 400
        assert len(content) > 20_000
    with open(files / "numbers.csv", newline="", encoding="utf-8") as stream:
        table = list(csv.DictReader(stream))
    assert [line["name"] for line in table] == list(PRINTED)
    assert [float(line["computed"]) for line in table] == [row.computed for row in found.rows]
    assert {line["name"] for line in table if line["agrees"] == "no"} == WRONG


def red(path) -> int:
    """Pixels that are clearly red, and not orange."""
    r, g, b = np.moveaxis(image.imread(path)[..., :3], -1, 0)
    return int(((r > 0.75) & (g < 0.7) & (g <= b) & (b < 0.75)).sum())


def test_crossing_is_marked_in_red(files, tmp_path, found):
    assert red(files / "figure_2_printed.png") > 20_000
    assert red(files / "figure_3_printed.png") > 200
    assert red(files / "figure_2.png") == red(files / "figure_3.png") == 0
    # One crossed step among many is seen, too.
    upper = np.array(found.current.state.upper)
    upper[9, 1] = found.current.state.lower[9, 1] - 1
    once = found.current._replace(state=Interval.unchecked(found.current.state.lower, upper))
    figures.figure_2(once).savefig(tmp_path / "once.png", dpi=130)
    assert red(tmp_path / "once.png") > 200


def test_the_paper_by_its_names():
    for name in gx.paper.__all__:
        assert getattr(gx.paper, name) is not None
    text = gx.paper.__doc__ or ""
    parts = ("Prop. 1", "Prop. 2, Lemma 1", "Def. 3, Prop. 3", "Corollary 1", "Lemma 2", "Lemma 3", "Theorem 1")
    for printed in (
        *parts,
        "Lemma 4",
        "Theorem 2",
        "Lemma 5",
        "Algorithm 1",
        "Illustrative Example",
        "Figures 2 and 3",
    ):
        assert f"    {printed} " in text
    named = {word.strip(",:;.()").partition("paper.")[2] for word in text.split() if word.startswith("paper.")}
    assert {name.partition(".")[0] for name in named} <= set(gx.paper.__all__)
    assert callable(gx.paper.stability)
    assert callable(gx.paper.gsisio)
