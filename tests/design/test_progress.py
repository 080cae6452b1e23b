"""A design that takes a while says what it is at, on a terminal or where it is asked to, and leaves no trace."""

import io
import sys
import time

import pytest

from gsisio_jax.design.progress import told


class Terminal(io.StringIO):
    def isatty(self):
        return True


def wait_for(stream, text):
    end = time.monotonic() + 30
    while text not in stream.getvalue() and time.monotonic() < end:
        time.sleep(0.01)
    assert text in stream.getvalue()


def test_the_line_names_the_stage_and_is_wiped_out(monkeypatch):
    stream = Terminal()
    monkeypatch.setattr(sys, "stderr", stream)
    with told("design_observer", None, patience=0.0) as say:
        say("choosing gains")
        wait_for(stream, "design_observer: choosing gains, ")
        say("more")
        wait_for(stream, "design_observer: more, ")
    # What is left on the screen: a terminal overwrites from every carriage return on.
    screen = ""
    for part in stream.getvalue().split("\r"):
        screen = part + screen[len(part) :]
    assert screen.strip() == ""
    assert "\n" not in stream.getvalue()


@pytest.mark.parametrize(
    ("stream", "progress", "patience"), [(io.StringIO, None, 0.0), (Terminal, False, 0.0), (Terminal, None, 30.0)]
)
def test_silence_off_a_terminal_where_it_is_unwanted_and_before_its_time(monkeypatch, stream, progress, patience):
    quiet = stream()
    monkeypatch.setattr(sys, "stderr", quiet)
    with told("design_observer", progress, patience) as say:
        say("choosing gains")
        time.sleep(0.05)
    assert quiet.getvalue() == ""


def test_a_notebook_shows_it_unasked(monkeypatch):
    """Jupyter's stream is known by where its class is from; there carriage returns overwrite as on a terminal."""

    class OutStream(io.StringIO):
        __module__ = "ipykernel.iostream"

    stream = OutStream()
    monkeypatch.setattr(sys, "stderr", stream)
    with told("design_observer", None, patience=0.0):
        wait_for(stream, "design_observer: starting, ")
    assert stream.getvalue().endswith("\r")


def test_asked_for_it_is_shown_anywhere_and_an_error_wipes_it_out(monkeypatch):
    stream = io.StringIO()
    monkeypatch.setattr(sys, "stderr", stream)

    def fails():
        with told("design_observer", True, patience=0.0):
            wait_for(stream, "starting")
            raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        fails()
    assert stream.getvalue().endswith("\r")
