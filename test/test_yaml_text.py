import pytest

from line_feature_node.yaml_text import parsed


def test_plain_values():
    assert parsed('a: [1, 2.5, true, text]\nb: {c: ~}') == {'a': [1, 2.5, True, 'text'], 'b': {'c': None}}
    assert parsed('') is None


def test_an_alias_stands_for_what_was_said_before():
    assert parsed('a: &x [1]\nb: *x') == {'a': [1], 'b': [1]}


def test_where_there_are_to_be_no_aliases_one_is_named():
    assert parsed('a: &x [1]', aliases=False) == {'a': [1]}
    with pytest.raises(ValueError, match=r'^\*x is an alias, and there are to be none$'):
        parsed('a: &x [1]\nb: *x', aliases=False)


@pytest.mark.parametrize('text', [
    '!!int ""', '!!float ""', '!!bool maybe', '!!timestamp x', '2001-99-99', '1:' * 200 + '1.5', '1' * 5000,
    '!!binary "ü"', '!!python/object:os.system x', '[1', '{[1]: 2}', 'a: *b', '\0', '--- 1\n--- 2'])
def test_what_is_no_yaml_is_a_sentence(text):
    with pytest.raises(ValueError, match=r'^not YAML \(.+\)$') as caught:
        parsed(text)
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('aliases', [True, False])
@pytest.mark.parametrize('text', ['[' * 50_000, '{a: ' * 50_000])
def test_what_is_nested_without_end_is_a_sentence_soon(text, aliases):
    """All levels of it would take hours."""
    with pytest.raises(ValueError, match='^nested too deep$'):
        parsed(text, aliases=aliases)


def test_settings_are_not_too_deep():
    assert parsed('{a: ' * 90 + '1' + '}' * 90, aliases=False)
