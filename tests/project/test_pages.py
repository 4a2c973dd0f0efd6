"""The pages of the documentation: their code runs, and the reference has every public name."""

import pathlib
import re
import shutil

import jax
import pytest

jax_x64 = jax.config.jax_enable_x64
