//! What a client verb works with: the controller, the namespace, the streams.

use crate::args::Global;
use crate::client::Client;
use crate::config;
use crate::error::CliError;
use crate::output::ui::Ui;

/// One run of a client verb.
pub(crate) struct Session {
    pub(crate) client: Client,
    pub(crate) ui: Ui,
    /// The namespace of objects that name none.
    pub(crate) namespace: String,
    /// Whether `-n` was given: then manifests may not name another.
    pub(crate) namespace_given: bool,
}

impl Session {
    /// Reads the kubeconfig. Nothing is sent yet.
    pub(crate) async fn open(global: &Global, ui: Ui) -> Result<Self, CliError> {
        let source = config::source(
            global.kubeconfig.as_deref(),
            |name| std::env::var_os(name),
            std::env::home_dir(),
        );
        let client = Client::new(config::load(source, global.context.as_deref()).await?)?;
        Ok(Session::new(client, ui, global.namespace.as_deref()))
    }

    pub(crate) fn new(client: Client, ui: Ui, namespace: Option<&str>) -> Self {
        let chosen = namespace.unwrap_or_else(|| client.default_namespace()).to_owned();
        Session { client, ui, namespace: chosen, namespace_given: namespace.is_some() }
    }
}
