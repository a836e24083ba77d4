"""Results browser: read-only web pages over a results database, served on the local machine.

``app`` defines the routes, ``security`` checks every request, ``database`` opens the database and
``query_params`` parses the query string. Each page has a module that computes its content with the
functions behind the figures; ``responses`` renders the content as HTML, JSON or CSV.
"""
