"""The scenes that ship: MJCF files and a few lines of Python each."""

from svkc.scenes.figure import BAR_HEIGHT as BAR_HEIGHT, FOLDER as FOLDER, PALM as PALM
from svkc.scenes.high_bar import GRIP as GRIP, high_bar as high_bar, swinging as swinging
