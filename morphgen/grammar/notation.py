"""The notation of grammars: parse texts to Lark trees; errors name the line and column."""

from __future__ import annotations

from functools import lru_cache

from lark import Lark, Token, Tree, UnexpectedInput

from morphgen.errors import GrammarError
from morphgen.grammar.limits import MAX_TEXT, MAX_WORD

_SYNTAX = r"""
grammar: _END? [statement (_END statement)*]
?statement: include | let | where | production
include: "include" (STRING | NAME)
let: "let" NAME "=" sum
where: "where" or_
production: NAME _ARROW alternative ("|" alternative)*
alternative: weight? item+
weight: _WEIGHT "(" sum ")"
item: [NAME ":"] NAME ["(" [argument ("," argument)*] ")"] [repetition]
argument: NAME "=" sum
repetition: "{" INT ["," INT] "}"

?or_: and_ ("or" and_)*
?and_: not_ ("and" not_)*
?not_: "not" not_ -> negation
     | comparison
?comparison: sum (COMPARATOR sum)*

?sum: product (SIGN product)*
?product: signed (FACTOR signed)*
?signed: SIGN signed -> unary
       | atom
?atom: QUANTITY -> quantity
     | INT -> quantity
     | NAME "(" [sum ("," sum)*] ")" -> call
     | NAME -> name
     | "(" or_ ")"

_ARROW: "->"
_WEIGHT: "@weight"
COMPARATOR: "<=" | ">=" | "==" | "!=" | "<" | ">"
SIGN: "+" | "-"
FACTOR: "*" | "/"
INT: /\d+(?![\w.])/
QUANTITY: /(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?[a-zA-Z]*/
NAME: /(?!(include|let|where|and|or|not)\b)[A-Za-z_]\w*/
STRING: /"[^"\n]*"/
_END: /\n(?=[^ \t\r\n|#])/
_CONTINUED: /\n(?=[ \t\r\n|#]|\Z)/
_COMMENT: /#[^\n]*/
_SPACE: /[ \t\r]+/
%ignore _CONTINUED
%ignore _COMMENT
%ignore _SPACE
"""

_TOKEN_NAMES = {
    "$END": "the end",
    "_END": "a new line",
    "NAME": "a name",
    "INT": "a whole number",
    "QUANTITY": "a number",
    "STRING": 'a "path"',
    "SIGN": "'+' or '-'",
    "FACTOR": "'*' or '/'",
    "COMPARATOR": "a comparison such as '<'",
    "LPAR": "'('",
    "RPAR": "')'",
    "LBRACE": "'{'",
    "RBRACE": "'}'",
    "VBAR": "'|'",
    "EQUAL": "'='",
    "COLON": "':'",
    "COMMA": "','",
    "AND": "'and'",
    "OR": "'or'",
    "NOT": "'not'",
    "INCLUDE": "'include'",
    "LET": "'let'",
    "WHERE": "'where'",
    "_WEIGHT": "'@weight'",
    "_ARROW": "'->'",
}


def parse_tree(text: str, origin: str, start: str) -> Tree[Token]:
    """Parse a text.

    Args:
        text: A grammar or a condition.
        origin: Name of the text in messages, usually its path.
        start: Rule of the syntax to apply: ``grammar``, or ``or_`` for a condition.

    Raises:
        GrammarError: If the text is too long or does not follow the rule.
    """
    if len(text) > MAX_TEXT:
        raise GrammarError(
            f"{origin}: a text of {len(text):,} characters; expected at most {MAX_TEXT:,}"
        )
    text = text.replace("\r\n", "\n")
    try:
        return _parser().parse(text, start=start)
    except UnexpectedInput as error:
        raise GrammarError(_message(error, text, origin)) from error


@lru_cache(maxsize=1)
def _parser() -> Lark:
    return Lark(_SYNTAX, parser="lalr", start=["grammar", "or_"], maybe_placeholders=True)


def _message(error: UnexpectedInput, text: str, origin: str) -> str:
    line, column, token = error.line, error.column, getattr(error, "token", None)
    ended = token is not None and token.type == "$END"
    if ended:
        lines = text.rstrip().split("\n")
        line, column = len(lines), len(lines[-1]) + 1
    names = getattr(error, "accepts", None) or getattr(error, "expected", None)
    names = names or getattr(error, "allowed", None) or ()
    expected = sorted({_TOKEN_NAMES.get(name, name) for name in names})
    if ended:
        token_text = "the end"
    elif token is not None:
        word = str(token) if len(token) <= MAX_WORD else f"{token[:MAX_WORD]}..."
        token_text = "the end of the line" if token.type == "_END" else repr(word)
    else:
        token_text = repr(text.split("\n")[line - 1][column - 1 : column])
    return f"{origin}:{line}:{column}: found {token_text}, expected {' or '.join(expected)}"
