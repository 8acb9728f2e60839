"""Tests of studies/where_it_pays."""
