"""The page of a run, by the path that notebooks know."""

from svkc.viz.html_page import show as show
