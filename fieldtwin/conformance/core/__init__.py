"""Test cases, observations, results and waivers: the common parts of both kinds of conformance test."""
