"""The tiny study of the core's tests."""

from tests.codesign.conftest import tiny as tiny
