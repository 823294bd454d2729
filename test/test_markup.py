from html.parser import HTMLParser

from hypothesis import given
from hypothesis import strategies as st

from line_feature_node.markup import Markup, joined, tag


class Read(HTMLParser):
    """What a browser would make of it."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.text = [], ''
        self.feed(text)
        self.close()

    def handle_starttag(self, name, attributes):
        self.tags.append((name, dict(attributes)))

    def handle_data(self, data):
        self.text += data


def test_elements_hold_elements_and_text():
    assert tag('p', 'a ', tag('b', 'c')) == '<p>a <b>c</b></p>'
    assert tag('path') == '<path></path>'


def test_names_of_attributes_are_those_of_html():
    made = tag('line', x1=1.23456789, y1=3, class_='grid', aria_label='a', name='n')
    assert made == '<line x1="1.23457" y1="3" class="grid" aria-label="a" name="n"></line>'


def test_void_elements_have_no_end():
    assert tag('img', alt='') == '<img alt="">'


@given(st.text(st.characters(exclude_categories=['Cs', 'Cc'])), st.text(st.characters(exclude_categories=['Cs', 'Cc'])))
def test_whatever_is_text_stays_text(inside, value):
    read = Read(tag('p', inside, title=value))
    assert read.tags == [('p', {'title': value})]
    assert read.text == inside


def test_markup_is_not_escaped_twice():
    assert joined(tag('b', '<'), '<', Markup('<br>')) == '<b>&lt;</b>&lt;<br>'
