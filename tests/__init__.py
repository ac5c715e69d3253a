"""The tests. This file keeps a package that other people install under the same name from standing in front of it."""
