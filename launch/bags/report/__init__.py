"""`flexsheet bag report`: one page about a recorded session, for people.

series      what is kept of a measured quantity over time, in memory that does not grow
strokes     the paper's errors, wherever the finger touches
album       the pictures
session     reads the bag, once
numbers     all that as one JSON document
findings    what was wrong, in sentences
charts      the pictures of the numbers
page        the HTML
"""
