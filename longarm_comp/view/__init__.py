"""`longarm view`: a page that shows a running graph, all of it from the graph's topics."""
