//! Writing calls and answers.

use super::{Answer, Value};

/// A `methodCall`.
#[must_use]
pub fn write_call(method: &str, params: &[Value]) -> String {
    let mut out = String::from("<?xml version=\"1.0\"?>\n<methodCall><methodName>");
    escape(method, &mut out);
    out.push_str("</methodName><params>");
    for param in params {
        out.push_str("<param>");
        value(param, &mut out);
        out.push_str("</param>");
    }
    out.push_str("</params></methodCall>\n");
    out
}

/// A `methodResponse`.
#[must_use]
pub fn write_answer(answer: &Answer) -> String {
    let mut out = String::from("<?xml version=\"1.0\"?>\n<methodResponse>");
    match answer {
        Ok(answer) => {
            out.push_str("<params><param>");
            value(answer, &mut out);
            out.push_str("</param></params>");
        }
        Err(fault) => {
            let code = ("faultCode".to_owned(), Value::Int(fault.code));
            let text = ("faultString".to_owned(), Value::String(fault.text.clone()));
            out.push_str("<fault>");
            value(&Value::Struct(vec![code, text]), &mut out);
            out.push_str("</fault>");
        }
    }
    out.push_str("</methodResponse>\n");
    out
}

fn value(value: &Value, out: &mut String) {
    out.push_str("<value>");
    match value {
        Value::Int(number) => element("int", &number.to_string(), out),
        Value::Bool(yes) => element("boolean", if *yes { "1" } else { "0" }, out),
        Value::String(text) => element("string", text, out),
        Value::Double(number) => element("double", &number.to_string(), out),
        Value::DateTime(text) => element("dateTime.iso8601", text, out),
        Value::Base64(text) => element("base64", text, out),
        Value::Array(values) => {
            out.push_str("<array><data>");
            values.iter().for_each(|one| self::value(one, out));
            out.push_str("</data></array>");
        }
        Value::Struct(members) => {
            out.push_str("<struct>");
            for (name, one) in members {
                out.push_str("<member>");
                element("name", name, out);
                self::value(one, out);
                out.push_str("</member>");
            }
            out.push_str("</struct>");
        }
    }
    out.push_str("</value>");
}

fn element(name: &str, text: &str, out: &mut String) {
    out.push_str(&format!("<{name}>"));
    escape(text, out);
    out.push_str(&format!("</{name}>"));
}

fn escape(text: &str, out: &mut String) {
    for char in text.chars() {
        match char {
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '&' => out.push_str("&amp;"),
            // A reader would make a line feed of it.
            '\r' => out.push_str("&#13;"),
            // XML 1.0 has no way to write them.
            '\0'..='\x08' | '\x0b' | '\x0c' | '\x0e'..='\x1f' | '\u{fffe}' | '\u{ffff}' => {
                out.push('\u{fffd}')
            }
            other => out.push(other),
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::{Call, DEEPEST, Fault, Malformed, answer, call};
    use super::*;

    fn text() -> impl Strategy<Value = String> {
        "[ \\t\\r\\na-z<>&\"'äß\\]]{0,12}"
    }

    fn any_value() -> impl Strategy<Value = Value> {
        let leaf = prop_oneof![
            any::<i32>().prop_map(Value::Int),
            any::<bool>().prop_map(Value::Bool),
            text().prop_map(Value::String),
            (-1e9..1e9).prop_map(Value::Double),
        ];
        leaf.prop_recursive(4, 40, 5, |inner| {
            prop_oneof![
                prop::collection::vec(inner.clone(), 0..5).prop_map(Value::Array),
                prop::collection::vec((text(), inner), 0..5).prop_map(Value::Struct),
            ]
        })
    }

    proptest! {
        #[test]
        fn what_is_written_is_read(params in prop::collection::vec(any_value(), 0..4)) {
            let written = write_call("registerPublisher", &params);
            prop_assert_eq!(call(&written), Ok(Call { method: "registerPublisher".to_owned(), params: params.clone() }));
            for param in params {
                prop_assert_eq!(answer(&write_answer(&Ok(param.clone()))), Ok(Ok(param)));
            }
        }

        #[test]
        fn any_text_is_refused_or_read(text in "[<>/a-z &;!?#\\[\\]0-9]{0,200}") {
            drop(call(&text));
            drop(answer(&text));
            drop(call(&format!("<methodCall><methodName>a</methodName><params>{text}")));
        }
    }

    #[test]
    fn faults_are_answers() {
        let fault = Fault { code: -3, text: "no <such> method".to_owned() };
        assert_eq!(answer(&write_answer(&Err(fault.clone()))), Ok(Err(fault)));
    }

    /// As rosmaster (Python) and roscpp write: declarations, white space, untyped strings.
    #[test]
    fn what_others_write_is_read() {
        let python = "<?xml version='1.0'?>\n<methodResponse>\n<params>\n<param>\n<value><array><data>\n<value><int>1</int>\
            </value>\n<value><string>ok &amp; well</string></value>\n<value>\n  <array><data>\n</data></array>\n</value>\n\
            </data></array></value>\n</param>\n</params>\n</methodResponse>\n";
        let expected =
            Value::Array(vec![Value::Int(1), "ok & well".into(), Value::Array(Vec::new())]);
        assert_eq!(answer(python), Ok(Ok(expected)));
        let roscpp = "<?xml version=\"1.0\"?>\r\n<methodCall><methodName>requestTopic</methodName>\r\n<params><param><value>/n\
            </value></param><param><value></value></param><param><value><i4>-5</i4></value></param><param><value><string/>\
            </value></param></params></methodCall>\r\n";
        let call = call(roscpp).unwrap();
        assert_eq!(call.params, ["/n".into(), "".into(), Value::Int(-5), "".into()]);
    }

    #[test]
    fn hostile_documents_are_refused() {
        let nested = |depth: usize| {
            let (open, close) =
                ("<value><array><data>".repeat(depth), "</data></array></value>".repeat(depth));
            format!(
                "<methodCall><methodName>a</methodName><params><param>{open}{close}</param></params></methodCall>"
            )
        };
        assert!(call(&nested(DEEPEST)).is_ok());
        assert_eq!(call(&nested(DEEPEST + 2)), Err(Malformed::Deep));
        assert_eq!(call(&nested(100_000)), Err(Malformed::Deep));
        let bomb = "<!DOCTYPE x [<!ENTITY a \"aaaa\">]><methodCall><methodName>&a;</methodName></methodCall>";
        assert_eq!(call(bomb), Err(Malformed::DocType));
        let unknown = "<methodCall><methodName>&a;</methodName></methodCall>";
        assert!(matches!(call(unknown), Err(Malformed::Xml(_))));
        for bad in ["", "<methodCall>", "<methodCall><methodName>a</methodName>", "{}", "<a/>"] {
            assert!(call(bad).is_err() && answer(bad).is_err(), "{bad}");
        }
    }
}
