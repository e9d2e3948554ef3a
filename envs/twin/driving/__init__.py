"""Driving on the twin: lanes, links, signals, car following, insertion."""
